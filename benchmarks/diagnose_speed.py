"""Time of `diagnose` on 40 states of 600 x 600 pixels: all effects, all pixels."""

from __future__ import annotations

import os
import time
from pathlib import Path
from tempfile import TemporaryDirectory

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np

from processing.capture_schema import Sample
from processing.diagnosis.run import diagnose_captures
from processing.instrument import InstrumentModel
from simulators.blind_suite import state_angles
from simulators.undeclared import Bench, Scene, digitize, expose, write_capture

INSTRUMENT = Path(__file__).resolve().parents[1] / "configs/instruments/rgb950.yaml"

for air in (False, True):
    with TemporaryDirectory() as folder:
        bench, random = Bench(rows=600, columns=600, oa=np.deg2rad(13.41 + 0.05)), np.random.default_rng(1)
        angles = state_angles(40, False, False)
        counts = digitize(bench, expose(bench, Scene(random, np.eye(4) if air else None), angles), random)
        path = Path(folder) / "capture.h5"
        sample = Sample(kind="air" if air else "unknown")
        write_capture(path, bench, counts, angles, sample, INSTRUMENT.read_text(encoding="utf-8"))
        wall, cpu = time.perf_counter(), time.process_time()
        judged, _ = diagnose_captures([path], InstrumentModel.load(INSTRUMENT))
        d = judged.diagnosis
        print(f"{sample.kind}: {time.perf_counter() - wall:.1f} s, {time.process_time() - cpu:.1f} s of processor time")
        print(
            f"  {d.verdict}, {[(e.kind, e.indistinguishable_from) for e in d.effects]}, load {os.getloadavg()[0]:.1f}"
        )
