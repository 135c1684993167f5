"""A public near-infrared polarimeter with two channel fluxes a state, no frames at all."""

import json
from pathlib import Path

import numpy as np
import pytest

from processing.calibration.known_sample import part_of
from processing.calibration.train import fit_trains
from processing.instrument.model import InstrumentModel
from processing.public_data.conversion import tables_of
from processing.reduction.mueller import reduce_mueller
from processing.storage.captures.capture import Capture
from processing.storage.formats.import_request import ImportRequest, read_sample
from processing.storage.formats.importing import import_capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Step

pytestmark = pytest.mark.measured


@pytest.mark.parametrize("wavelength", [1300, 1600])
def test_two_channels_a_state(wavelength: int, public_files, configs: Path, tmp_path: Path) -> None:
    files = public_files("drr-wollaston-nir")
    tables = {table.name: table for table in tables_of("drr-wollaston-nir", files)}
    instrument = configs / "instruments/drr_wollaston.yaml"
    for name, measured, sample in (("cal", "air", "air"), ("sample", "plate", "unknown")):
        request = ImportRequest(
            states=tables[f"{measured}_{wavelength}nm"].write(tmp_path)[0],
            out=tmp_path / f"{name}.h5",
            wavelength_nm=wavelength,
            instrument=instrument,
            sample=read_sample(sample),
        )
        header = import_capture(request)
        assert header.channels == ("left", "right")
        assert header.sample.kind == sample
    raw = json.loads(files["cal_results.json"].read_text(encoding="utf-8"))
    with Capture(tmp_path / "cal.h5") as capture:
        stored = np.stack([capture.frames(k)[:, 0, 0] for k in range(46)])
        assert sorted(stored[:, 0]) == sorted(raw[f"Cal_Il_{wavelength}"])
        # Air at 0 degrees: nearly all light in one channel, so the polarizer stands across the left one's axis.
        assert stored[0, 1] > 5 * stored[0, 0]
        # The nominal file has the polarizer at 0; the fit finds it across, from another start than the nominal one.
        model = InstrumentModel.load(instrument).at(wavelength)
        free = [f"{e}.{f}" for e in ("psg_retarder", "psa_retarder") for f in ("retardance_deg", "azimuth_deg")]
        part = part_of(capture, model, slice(0, 1), slice(0, 1))
        fitted = fit_trains([part], [*free, "psg_polarizer.azimuth_deg"])[0]
    assert fitted.residual_over_mean < 0.03
    assert abs(abs(fitted.model.generator[0].azimuth_deg % 180) - 90) < 5
    with Capture(tmp_path / "sample.h5") as capture:
        reduce_mueller(capture, fitted.model, tmp_path / "m.h5", (Step("reduce", {}),))
    image = MuellerImage.load(tmp_path / "m.h5")
    normalized = image.values[..., 0, 0] / image.values[0, 0, 0, 0]
    # A half-wave plate near its design wavelength: no diattenuation, m33 close to -1, det > 0.
    assert np.linalg.norm(normalized[0, 1:]) < 0.05
    assert normalized[3, 3] < -0.9
    assert np.linalg.det(normalized) > 0.8
