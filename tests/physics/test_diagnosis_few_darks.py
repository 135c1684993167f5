"""Two dark frames only: their noise is the same in every state, and is no fault of the instrument."""

import numpy as np
import pytest

from processing.diagnosis.captured.read_capture import read_capture
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture

GAIN, READ, BLACK = 2.0, 6.0, 100
ANGLES = {"psg": 4.7 * np.arange(24), "psa": 23.1 * np.arange(24)}


@pytest.mark.parametrize(("kind", "unknowns"), [("air", 1), ("unknown", 16)])
def test_noise_of_two_darks_is_expected_in_the_residual(kind, unknowns, synthetic_capture, configs):
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662)
    rows = model.rows(ANGLES).reshape(-1, 16)
    random = np.random.default_rng(8)
    # Dim, so that what the darks add is a good part of the noise.
    light = random.poisson(300 * (rows @ np.eye(4).ravel())[:, None, None, None], (24, 1, 50, 60))
    frames = np.concatenate([np.zeros((2, 1, 50, 60)), light]) + random.normal(0, READ, (26, 1, 50, 60))
    path = synthetic_capture(
        np.round(frames / GAIN + BLACK).astype(np.uint16),
        {axis: np.r_[0, 0, turned] for axis, turned in ANGLES.items()},
        role=("dark",) * 2 + ("sample",) * 24,
        sample={"kind": kind},
        instrument_yaml=(configs / "instruments/rgb950.yaml").read_text(),
        detector={"gain_e_per_count": GAIN, "read_noise_e": READ, "black_level_counts": BLACK, "bits": 16},
    )
    with Capture(path) as capture:
        data = read_capture(capture, model)
    a = rows @ np.eye(4).reshape(16, 1) if kind == "air" else rows
    signal = data.signal.reshape(24, -1).astype(float)
    left = signal - a @ np.linalg.lstsq(a, signal, rcond=None)[0]
    outside = np.eye(24) - a @ np.linalg.pinv(a)
    variance = (data.slope * np.maximum(signal.mean(axis=1), 0) + data.floor) @ np.diag(outside)
    freedom = 3000 * (24 - unknowns)
    assert (left**2).sum() / (3000 * variance) == pytest.approx(1, abs=3 * np.sqrt(2 / freedom))
