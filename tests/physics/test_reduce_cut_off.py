"""States whose dark part is cut off at zero are left out of a reduction, as `diagnose` leaves them out."""

from pathlib import Path

import numpy as np
import pytest

from processing.errors import NotDetermined
from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.polarization import mueller
from processing.reduction.mueller import reduce_mueller
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.products.images import MuellerImage

DETECTOR = {"gain_e_per_count": 1.0, "read_noise_e": 2.0, "black_level_counts": 100.0, "bits": 16}


@pytest.fixture
def make(synthetic_capture, configs: Path):
    def capture(lost: int) -> tuple[Path, np.ndarray]:
        """A polarizer in counts with an offset, which the header does not know, that cuts off so many states."""
        instrument = configs / "instruments/rgb950.yaml"
        table = rotating_retarders(0.01)
        w = InstrumentModel.load(instrument).at(662).rows(table.angles_deg).reshape(40, 16)
        truth = 20_000 * mueller.polarizer(0.4).reshape(16)
        level = np.sort(w @ truth)
        offset = -100 - (level[lost - 1] + level[lost]) / 2 if 0 < lost < 40 else -60_000.0 * (lost > 0)
        rng = np.random.default_rng(3)
        electrons = rng.poisson((w @ truth)[:, None, None, None], size=(40, 1, 40, 50))
        counts = np.clip(np.round(electrons + rng.normal(0, 2, electrons.shape) + 100 + offset), 0, 65535)
        path = synthetic_capture(
            counts.astype(np.uint16), dict(table.angles_deg), instrument_yaml=instrument.read_text(), detector=DETECTOR
        )
        return path, (counts == 0).mean(axis=(1, 2, 3)) > 0.01

    return capture


def test_they_are_left_out_and_named(make, tmp_path):
    path, cut = make(6)
    assert 4 < cut.sum() < 12
    with Capture(path) as capture:
        facts = reduce_mueller(capture, capture.instrument, tmp_path / "m.h5", ())
    assert facts["states"] == 40 - cut.sum()
    (warning,) = (text for text in facts["warnings"] if "cut off at zero" in text)
    assert all(str(k) in warning for k in np.flatnonzero(cut))
    assert MuellerImage.load(tmp_path / "m.h5").w.shape[0] == 40 - cut.sum()


def test_too_many_left_out_are_named_where_the_rest_is_not_enough(make, tmp_path):
    path, cut = make(28)
    with Capture(path) as capture, pytest.raises(NotDetermined, match="cut off at zero") as refusal:
        reduce_mueller(capture, capture.instrument, tmp_path / "m.h5", ())
    assert all(str(k) in str(refusal.value) for k in np.flatnonzero(cut))


def test_nothing_is_left_out_where_counts_are_just_low(make, tmp_path):
    path, cut = make(0)
    assert not cut.any()
    with Capture(path) as capture:
        facts = reduce_mueller(capture, capture.instrument, tmp_path / "m.h5", ())
    assert facts["states"] == 40
    assert not any("cut off" in text for text in facts["warnings"])


def test_a_capture_of_nothing_else_is_refused(make, tmp_path):
    path, _ = make(40)
    with Capture(path) as capture, pytest.raises(CaptureError, match="every state are cut off"):
        reduce_mueller(capture, capture.instrument, tmp_path / "m.h5", ())
