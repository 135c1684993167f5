"""Frames of a polarization camera that are taken again and again, with nothing that turns."""

import numpy as np
import pytest

from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.instrument.model import InstrumentModel
from processing.storage.formats.import_request import ImportRequest, read_sample
from processing.storage.formats.importing import import_capture


@pytest.mark.parametrize("frames", [1, 2, 8])
def test_a_list_of_states_without_a_column_of_an_axis(frames, configs, tmp_path):
    random = np.random.default_rng(0)
    scene = 200 + 100 * np.sin(np.arange(64) / 9)[:, None] * np.cos(np.arange(64) / 7)
    # Channels 90 45 / 135 0 of linear light, the one of 45 degrees with a gain of 1.03.
    light = 16 * scene * np.tile([[0.4, 0.55 * 1.03], [0.5, 0.65]], (32, 32))
    counts = np.round(random.poisson(light * 40, (frames, 64, 64)) / 40).astype(np.uint16)
    np.save(tmp_path / "frames.npy", counts)
    states, instrument = tmp_path / "states.csv", configs / "instruments/linear_stokes.yaml"
    states.write_text("state\n" + "".join(f"{k}\n" for k in range(frames)), encoding="utf-8")
    request = ImportRequest(
        states=states,
        stack=str(tmp_path / "frames.npy"),
        out=tmp_path / "c.h5",
        wavelength_nm=550,
        instrument=instrument,
        sample=read_sample("unknown"),
    )
    import_capture(request)
    diagnosis = diagnose_captures([request.out], InstrumentModel.load(instrument))[0].diagnosis
    assert diagnosis.error_before.chi2_reduced > 3
    assert diagnosis.error_after.chi2_reduced < 1.1
