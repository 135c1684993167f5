""" "Consistent" is said where a fault of typical size would have been seen, and nowhere else."""

import numpy as np
import pytest

from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.instrument.model import InstrumentModel
from processing.storage.formats.import_request import ImportRequest, read_sample
from processing.storage.formats.importing import import_capture
from simulators.blind.undeclared_captures import state_angles

STATES = 24


@pytest.fixture
def judged(tmp_path, configs):
    instrument = configs / "instruments/rgb950.yaml"

    def diagnosed(scatter: float, sigma: float | None):
        """One pixel in air, its intensities off by random amounts of so many times their mean."""
        angles = state_angles(STATES, False, False)
        w = InstrumentModel.load(instrument).at(662).rows(angles).reshape(STATES, 16)
        light = 1000 * w @ np.eye(4).reshape(16)
        light = light + scatter * light.mean() * np.random.default_rng(2).standard_normal(STATES)
        column, value = ("", "") if sigma is None else (",sigma", f",{sigma * light.mean()}")
        lines = [f"state,psg_deg,psa_deg,channel_camera{column}"]
        pairs = zip(angles["psg"], angles["psa"], light, strict=True)
        lines += [f"{k},{g},{a},{y}{value}" for k, (g, a, y) in enumerate(pairs)]
        states = tmp_path / "states.csv"
        states.write_text("\n".join(lines) + "\n", encoding="utf-8")
        request = ImportRequest(
            states=states, out=tmp_path / "c.h5", wavelength_nm=662, instrument=instrument, sample=read_sample("air")
        )
        import_capture(request)
        return diagnose_captures([tmp_path / "c.h5"], InstrumentModel.load(instrument))[0].diagnosis

    return diagnosed


def test_one_pixel_without_noise_that_scatters_widely(judged):
    d = judged(0.3, None)
    assert d.verdict in ("undetermined", "unexplained")
    if d.verdict == "undetermined":
        assert "sigma" in d.recommendation


def test_one_pixel_that_scatters_far_more_than_its_noise(judged):
    assert judged(0.3, 0.005).verdict == "unexplained"


def test_one_pixel_that_is_as_precise_as_it_says(judged):
    d = judged(0.0005, 0.0005)
    assert d.verdict == "consistent"
    assert d.error_before.chi2_reduced == pytest.approx(1.0, abs=0.8)
