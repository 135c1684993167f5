"""What it costs that each state is on the disc before the next one is handed over.

    python benchmarks/durability.py [--seconds 1.0] [--states 20] [--rows 2048] [--columns 2448] [--out FOLDER]

States of full size are handed to the writer of `acquire` at the pace of a bench. Dead time is what the measuring thread
waited for the writer, as a part of the whole; the rest of the writer's work lies beside the moves.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from acquisition.capture.writer import CaptureWriter, StateRecord
from drivers.motion import Position
from processing.instrument.states import rotating_retarders
from processing.storage.capture_schema import CaptureHeader


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1.0, help="of a state: move, settling and exposure")
    parser.add_argument("--states", type=int, default=20)
    parser.add_argument("--rows", type=int, default=2048)
    parser.add_argument("--columns", type=int, default=2448)
    parser.add_argument("--out", type=Path, default=None, help="folder on the disc to be measured")
    given = parser.parse_args()
    header = CaptureHeader(title="durability", simulated=True, mode="drr", wavelength_nm=662)
    table = rotating_retarders(0.01, states=given.states)
    shape = given.rows, given.columns
    frame = np.random.default_rng(1).integers(0, 4096, shape, dtype=np.uint16)
    with tempfile.TemporaryDirectory(dir=given.out) as folder:
        begin_s = time.perf_counter()
        writer = CaptureWriter.create(Path(folder) / "capture.h5", header, table, shape, "2026-01-01T00:00:00+00:00")
        created_s = time.perf_counter() - begin_s
        waited_s, safe_s = [], []
        begin_s = time.perf_counter()
        for k in range(given.states):
            time.sleep(given.seconds)
            handed_s = time.perf_counter()
            writer.put(StateRecord(k, frame, {axis: Position(0.0, 0.0) for axis in table.angles_deg}))
            waited_s.append(time.perf_counter() - handed_s)
            if k % 4 == 3:
                # Now and then how long a state takes until it is safe.
                writer.settle()
                safe_s.append(time.perf_counter() - handed_s)
        total_s = time.perf_counter() - begin_s
        writer.seal("complete", {})
    print(
        f"{given.states} states of {frame.nbytes / 1e6:.1f} MB, one in {given.seconds:g} s: layout {created_s:.2f} s, "
        f"a state safe after {1e3 * np.median(safe_s):.0f} ms (worst {1e3 * np.max(safe_s):.0f}), "
        f"dead time {100 * sum(waited_s) / total_s:.2f} %"
    )


if __name__ == "__main__":
    main()
