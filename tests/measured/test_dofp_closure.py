"""Raw mosaics of a real polarization sensor: what its four channels say about themselves."""

from pathlib import Path

import numpy as np
import pytest

from processing.public_data.sets import SHIPPED
from processing.reduction.stokes import reduce_stokes
from processing.storage.captures.capture import Capture
from processing.storage.formats.import_request import ImportRequest
from processing.storage.formats.importing import import_capture
from processing.storage.products.images import StokesImage
from processing.storage.products.product import Product, Step

pytestmark = pytest.mark.measured


@pytest.mark.parametrize("scene", ["camera", "fruits"])
def test_closure_of_the_channels(scene: str, configs: Path, tmp_path: Path) -> None:
    file = SHIPPED / f"dofp-imx250mzr/{scene}_crop.png"
    states = tmp_path / "states.csv"
    states.write_text(f"state,file\n0,{file}\n", encoding="utf-8")
    instrument = configs / "instruments/linear_stokes.yaml"
    out = tmp_path / "capture.h5"
    # The wavelength is not known (white light); the model's analyzers have no dispersion.
    import_capture(ImportRequest(states=states, out=out, wavelength_nm=550, instrument=instrument))
    with Capture(out) as capture:
        assert capture.instrument is not None
        raw = capture.frames(0)[0].astype(float)
        facts = reduce_stokes(
            capture, capture.instrument, tmp_path / "s.h5", (Step("reduce", {}),), method="superpixel"
        )
    image = StokesImage.load(tmp_path / "s.h5")
    i90, i45, i135, i0 = raw[0::2, 0::2], raw[0::2, 1::2], raw[1::2, 0::2], raw[1::2, 1::2]
    good = image.mask == 0
    np.testing.assert_allclose(image.values[1][good], (i0 - i90)[good], atol=1e-3)
    np.testing.assert_allclose(image.values[2][good], (i45 - i135)[good], atol=1e-3)
    with Product(tmp_path / "s.h5") as product:
        np.testing.assert_allclose(product.get("closure")[good], (i0 + i90 - i45 - i135)[good], atol=1e-3)
    # Ideal analyzers of equal gain would give 0. Both scenes show the same 2 % of S0: the sensor, not the scene.
    assert facts["median_closure_over_s0"] == pytest.approx(-0.021, abs=0.003)
    saturated = (raw >= 255).reshape(raw.shape[0] // 2, 2, -1, 2).any(axis=(1, 3))
    assert np.array_equal((image.mask & 1) != 0, saturated)
