"""Run the blind suite: `python benchmarks/blind_suite.py [COUNT] [SEED] [FOLDER]`; prints the confusion matrix.

Seeds below 1000 are for development; the reported run has seed 5000 and 300 captures.
"""

from __future__ import annotations

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
    from processing.capture import Capture
    from processing.diagnosis.run import diagnose_captures
    from processing.instrument import InstrumentModel
    from processing.yaml_file import parse_yaml

    path = Path(capture)
    with Capture(path) as source:
        model = parse_yaml(source.header.instrument_yaml, InstrumentModel)
    judged, _ = diagnose_captures([path], model)
    return path.stem, json.loads(judged.diagnosis.model_dump_json())


def main() -> None:
    from simulators.blind_suite import judge, make, table

    count = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 5000
    folder = Path(sys.argv[3]) if len(sys.argv) > 3 else Path(mkdtemp(prefix="blind_"))
    cases = make(folder, count, seed, ROOT / "configs")
    start = time.perf_counter()
    results = {}
    with ProcessPoolExecutor(2) as workers:
        for k, (name, result) in enumerate(workers.map(one, [str(folder / f"{c.name}.h5") for c in cases]), 1):
            results[name] = result
            print(f"\r{k} of {count}", end="", file=sys.stderr, flush=True)
    (folder / "results.json").write_text(json.dumps(results, indent=1))
    print(f"\n{folder}: {count} captures, seed {seed}, {time.perf_counter() - start:.0f} s")
    print(table(judge(cases, results)))


if __name__ == "__main__":
    main()
