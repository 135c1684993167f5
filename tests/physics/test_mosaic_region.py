"""A region at an odd offset: the analyzers are where the capture says, not where the instrument file has them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from processing.diagnosis.captured.read_capture import read_capture
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import Detector

LEVEL = {"0": 400, "45": 800, "90": 1200, "135": 1600}


@pytest.mark.parametrize(("top", "left"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_the_diagnosis_reads_each_channel_behind_its_own_analyzer(
    synthetic_capture, configs: Path, top: int, left: int
) -> None:
    model = InstrumentModel.load(configs / "instruments" / "linear_stokes.yaml").at(662.0)
    sensor = np.array(model.mosaic)
    r, c = np.mgrid[top : top + 16, left : left + 20]
    frame = np.vectorize(LEVEL.get)(sensor[r % 2, c % 2])
    noise = np.random.default_rng(1).normal(0, 3, (4, 1, 16, 20))
    path = synthetic_capture(
        (frame + 64 + noise).astype(np.uint16),
        {"psg": np.zeros(4)},
        channels=("mosaic",),
        mosaic=tuple(map(tuple, np.roll(sensor, (-top, -left), axis=(0, 1)))),
        detector=Detector(black_level_counts=64, gain_e_per_count=2.6, read_noise_e=2.3, bits=12),
    )
    with Capture(path) as capture:
        data = read_capture(capture, model)
    means = data.signal.mean(axis=(0, 2, 3)) * (4095 - 64)
    np.testing.assert_allclose(means, [LEVEL[channel.name] for channel in model.channels], rtol=0.02)
