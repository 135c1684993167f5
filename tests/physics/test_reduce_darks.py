"""Darks that do not fit the exposures of the sample are told, with the counts that it may cost."""

import numpy as np
import pytest

from processing.capture import Capture
from processing.correction import Correction

ANGLES = {"psg": np.arange(6.0)}
ROLE = ("dark", "dark", "sample", "sample", "sample", "sample")


@pytest.mark.parametrize(
    ("exposure_s", "rate", "told"),
    [
        ([0.1, 0.1, 0.1, 0.1, 0.1, 0.1], 500.0, None),
        ([0.1, 0.1, 0.1, 0.4, 0.4, 0.4], 500.0, "Take darks at the exposures of the sample"),
        ([0.1, 0.4, 0.1, 0.4, 0.1, 0.4], 500.0, "leaves up to 75 counts"),
        ([0.1, 0.4, 0.1, 0.4, 0.1, 0.4], 1.0, None),
    ],
)
def test_dark_current_of_other_exposures(synthetic_capture, exposure_s, rate, told) -> None:
    exposure = np.array(exposure_s)
    frames = np.broadcast_to((64 + rate * exposure)[:, None, None, None], (6, 1, 4, 6)).astype(np.uint16)
    with Capture(synthetic_capture(frames, ANGLES, role=ROLE, exposure_s=exposure)) as capture:
        warnings = " ".join(Correction.of(capture).warnings)
    assert (told in warnings) if told else not warnings
