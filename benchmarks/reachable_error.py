"""What error of M could be reached on real benches: by who knows the set, by who knows its distribution, by `diagnose`.

    OPENBLAS_NUM_THREADS=1 python benchmarks/reachable_error.py DIR --seeds 1-2 --draws 20 --pixels 32

Each seed is the scenes of one bench, and each draw a set of faults on it (`simulators/blind/bench_bound.py`). Whether
intervals hold is calibration by simulation: faults and data are drawn, the posterior has to hold them.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from real_benches import ROOT, seeds

from simulators.blind.bench_bound import Linearized, Reached
from simulators.blind.bench_table import FLOOR, NEARLY, REACHED

WHO = ("the set is known", "its distribution is known", "diagnose")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=seeds, default=seeds("1-2"), help="scenes, as 1-2")
    parser.add_argument("--draws", type=int, default=20, help="sets of faults on each")
    parser.add_argument("--pixels", type=int, default=32, help="side of the images")
    options = parser.parse_args()
    found: list[tuple[Reached, ...]] = []
    for seed in options.seeds:
        bench = Linearized.of(options.folder, seed, ROOT / "configs", options.pixels)
        for drawn in bench.draws(options.draws, seed):
            found.append(drawn)
            print(f"\r{len(found)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    print(f"{len(found)} benches")
    least = np.array([drawn[0].error for drawn in found])
    for k, who in enumerate(WHO):
        error, told, held = (np.array([getattr(d[k], name) for d in found]) for name in ("error", "told", "held"))
        print(
            f"{who}: error of M/m00, median {np.median(error):.5f}, rms over told {rms(error) / rms(told):.2f}, "
            f"95 % intervals hold in {100 * held.mean():.1f} %; at most {REACHED} times the true set's "
            f"{100 * np.mean(error <= REACHED * least + FLOOR):.0f} %, {NEARLY:g} times "
            f"{100 * np.mean(error <= NEARLY * least + FLOOR):.0f} %"
        )


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    main()
