"""Run the blind suite: `python benchmarks/blind_suite.py [COUNT] [SEED] [FOLDER] [--only GROUP | --beside KIND]`.

Prints the confusion matrix. GROUP is single, two, none or unlisted, to draw that kind of case alone; KIND is an effect,
to draw it and another one in every case. Seeds below 1000
are for development, 1000 for CI; which seeds a reported run had is in docs/studies/blind-suites.md.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import mkdtemp

os.environ["OPENBLAS_NUM_THREADS"] = "1"

ROOT = Path(__file__).resolve().parents[1]


def one(capture: str) -> tuple[str, dict]:
    """Diagnose one capture with the instrument model that it declares."""
    from processing.diagnosis.instrument.diagnose import diagnose_captures
    from processing.instrument.model import InstrumentModel
    from processing.storage.captures.capture import Capture
    from processing.yaml_file import parse_yaml

    path = Path(capture)
    with Capture(path) as source:
        model = parse_yaml(source.header.instrument_yaml, InstrumentModel)
    try:
        judged, _ = diagnose_captures([path], model)
    except Exception as error:  # noqa: BLE001 - a crash is a wrong answer of this case, not the end of the suite
        crash = {"rms_percent": float("inf"), "chi2_reduced": float("inf"), "held_out": ""}
        return path.stem, {
            "verdict": f"crashed: {error}",
            "effects": [],
            "noise_floor_percent": 0.0,
            "error_before": crash,
            "error_after": crash,
        }
    return path.stem, json.loads(judged.diagnosis.model_dump_json())


def main() -> None:
    from simulators.blind.judge import judge, table
    from simulators.blind.suite import SHARES, make
    from simulators.blind.undeclared_faults import LISTED

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", nargs="?", type=int, default=300)
    parser.add_argument("seed", nargs="?", type=int, default=5000)
    parser.add_argument("folder", nargs="?", type=Path)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--only", choices=list(SHARES))
    which.add_argument("--beside", choices=list(LISTED), metavar="KIND")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    folder = options.folder or Path(mkdtemp(prefix="blind_"))
    start = time.perf_counter()
    cases = make(folder, options.count, options.seed, ROOT / "configs", options.only, options.beside)
    results = {}
    with ProcessPoolExecutor(options.workers) as workers:
        for k, (name, result) in enumerate(workers.map(one, [str(folder / f"{c.name}.h5") for c in cases]), 1):
            results[name] = result
            print(f"\r{k} of {len(cases)}", end="", file=sys.stderr, flush=True)
            if k % 10 == 0 or k == len(cases):
                (folder / "results.json").write_text(json.dumps(results, indent=1))
    print(f"\n{folder}: {len(cases)} captures, seed {options.seed}, {time.perf_counter() - start:.0f} s")
    print(table(judge(cases, results)))


if __name__ == "__main__":
    main()
