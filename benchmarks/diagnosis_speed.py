"""Time and memory of `diagnose` by the size of the images, the number of faults and of captures.

Run: .venv/bin/python benchmarks/diagnosis_speed.py [--only 600] [--folder DIR]

Captures of 40 states are made by the physics of the blind benches (`simulators.blind`) at their full size, pixel by
pixel, which takes two minutes for the largest. Each case is diagnosed by a program of its own. Prints what it took by
the clock and of the processor, the most memory that it held, and how many of the faults are among the causes that were
told. On a busy machine half the processor time is the least that two quiet cores would take.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from measuring import Program

from processing.computing.threads import thread_count
from processing.instrument.model import InstrumentModel
from processing.storage.capture_schema import Sample
from simulators.blind.lab_priors import PRIORS
from simulators.blind.real_bench import Disc, flat_mueller
from simulators.blind.suite import declared_bench, state_angles
from simulators.blind.undeclared_captures import Scene, digitize, expose, write_capture
from simulators.blind.undeclared_faults import LISTED

ROOT = Path(__file__).resolve().parents[1]
INSTRUMENT = ROOT / "configs/instruments/rgb950.yaml"
NM, STATES, ELECTRONS, SEED = 662.0, 40, 18_000.0, 1
ONE = ("psa_azimuth",)
EIGHT = (
    *("psg_retardance", "psa_azimuth", "retarder_transmission", "rotation_eccentricity", "source_drift"),
    *("detector_nonlinearity", "image_drift", "beam_wander"),
)


@dataclass(frozen=True)
class Case:
    """What is diagnosed together, and the limits: by the clock, and of memory."""

    name: str
    faults: tuple[str, ...]
    rows: int
    columns: int
    samples: tuple[str, ...]
    seconds: float
    gib: float = 3.0


CASES = (
    Case("one fault, 600 x 600", ONE, 600, 600, ("sphere",), 10),
    Case("eight faults, 600 x 600", EIGHT, 600, 600, ("sphere",), 60),
    Case("eight faults, 1000 x 1000", EIGHT, 1000, 1000, ("sphere",), 60),
    Case("eight faults, 2048 x 2448", EIGHT, 2048, 2448, ("sphere",), 300),
    Case("eight faults, 600 x 600, three captures", EIGHT, 600, 600, ("sphere", "flat", "air"), 120),
)


def capture(path: Path, case: Case, sample: str) -> None:
    """Write one capture of a bench with the faults of a case."""
    random = np.random.default_rng(SEED)
    model = InstrumentModel.load(INSTRUMENT)
    scenes = {
        "sphere": Disc(random),
        "flat": Scene(random, flat_mueller(random), brightness=0.3),
        "air": Scene(random, np.eye(4)),
    }
    bench = declared_bench(model.at(NM), NM, 1, mosaic=False, electrons=ELECTRONS)
    bench.rows, bench.columns = case.rows, case.columns
    for k, kind in enumerate(case.faults):
        LISTED[kind](bench, np.random.default_rng([SEED, k]), STATES, PRIORS[kind].sizes)
    angles = state_angles(STATES, mosaic=False, zigzag=False)
    light = expose(bench, scenes[sample], angles)
    counts = np.concatenate([digitize(bench, frame[None], random) for frame in light])
    known = Sample(kind="air" if sample == "air" else "unknown")
    write_capture(path, bench, counts, angles, known, INSTRUMENT.read_text(encoding="utf-8"))


def told(result: Path, faults: tuple[str, ...]) -> str:
    """How many faults are among the causes, or named beside them."""
    found = json.loads(result.read_text(encoding="utf-8"))
    named = {text.partition("[")[0].partition(" in ")[0] for e in found["effects"] for text in _names(e)}
    return f"{len(named & set(faults))} of {len(faults)} told, {found['verdict']}"


def _names(effect: dict[str, object]) -> list[str]:
    others = effect["indistinguishable_from"]
    return [str(effect["kind"]), *(map(str, others) if isinstance(others, list) else ())]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--folder", type=Path, help="where captures are written; default: a temporary folder")
    options = parser.parse_args()
    print(f"{thread_count()} threads, load {os.getloadavg()[0]:.1f}")
    for case in CASES:
        if options.only in case.name:
            with tempfile.TemporaryDirectory(dir=options.folder) as name:
                measure(case, Path(name))


def measure(case: Case, folder: Path) -> None:
    """Make the captures of a case, diagnose them, print a line."""
    paths = [folder / f"{sample}.h5" for sample in case.samples]
    for path, sample in zip(paths, case.samples, strict=True):
        capture(path, case, sample)
    command = [sys.executable, "-m", "processing.commands.diagnose", *map(str, paths)]
    run = Program([*command, "--instrument", str(INSTRUMENT), "--json", str(folder / "a.json")])
    spent = run()
    took = f"{spent.wall_s:6.1f} s (target {case.seconds:g}), of the processor {spent.processor_s:6.1f} s"
    held = f"{run.peak_mib / 1024:4.2f} GiB (target {case.gib:g})"
    print(f"{case.name:<40} {took}, {held}; {told(folder / 'a.json', case.faults)}", flush=True)


if __name__ == "__main__":
    main()
