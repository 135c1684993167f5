"""Where the time of a capture goes on the simulated rig at real speed.

Run: .venv/bin/python benchmarks/time_ledger.py [--exposure 0.1] [--runs 3]

Takes the default plan (40 states, 4 darks) on the default rig with clock_speed 1. Needs a quiet machine: the emulators,
the camera's drawing and the measuring program share its cores.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from simulated_rig import write_rig

from processing.storage.capture import Capture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--exposure", type=float, default=0.02, help="seconds")
    parser.add_argument("--runs", type=int, default=3)
    given = parser.parse_args()
    print(
        "run  states  unavoidable s  moves  settling  exposure  camera's own | beyond it s     % "
        "| if the camera's own counts as lost %"
    )
    excess = []
    with tempfile.TemporaryDirectory() as name:
        rig = write_rig(Path(name) / "rig.yaml", {"clock_speed": 1})
        for run in range(given.runs):
            out = Path(name) / str(run)
            arguments = ["--rig", rig, "--omega", "35", "--exposure", str(given.exposure), "--out", out]
            program = [sys.executable, "-c", "from acquisition.commands.application import main; main()"]
            subprocess.run([*program, *map(str, arguments)], check=True, capture_output=True)
            with Capture(next(out.glob("*.h5"))) as capture:
                ledger = capture.closing["ledger"]
                light_s = float((capture.column("exposure_s") * capture.column("repeats")).sum())
            total, camera = ledger["unavoidable_s"], ledger["of_it_readout_s"]
            moves = total - light_s - camera - ledger["settling_s"]
            excess.append(ledger["excess"])
            print(
                f"{run + 1:3d} {ledger['states']:7.0f} {total:14.2f} {moves:7.2f} {ledger['settling_s']:9.2f} "
                f"{light_s:9.2f} {camera:13.2f} | {total * ledger['excess']:11.2f} {100 * ledger['excess']:5.1f} "
                f"| {100 * ledger['excess_with_readout']:23.1f}"
            )
    print(f"median: {100 * np.median(excess):.1f} % beyond the unavoidable")


if __name__ == "__main__":
    main()
