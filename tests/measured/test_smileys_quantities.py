"""All derived maps of a measured, strongly depolarizing scene (two discs with faces, 630 nm)."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from processing.polarization import gradients
from processing.polarization.quantities import PAPER_PAIRS
from processing.reduction.mueller import reduce_mueller
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Step

pytestmark = pytest.mark.measured

DISC, BACKGROUND = (slice(140, 180), slice(190, 230)), (slice(300, 340), slice(60, 100))


@pytest.fixture(scope="module")
def product(public_files, configs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    imported = runpy.run_path(str(Path(__file__).with_name("test_drr_imaging.py")))["imported"]
    folder = tmp_path_factory.mktemp("smileys")
    path = imported(public_files("drr-imaging-630nm"), "smileys", folder / "c.h5", configs)
    with Capture(path) as capture:
        assert capture.instrument is not None
        reduce_mueller(capture, capture.instrument, folder / "m.h5", (Step("reduce", {}),))
    return folder / "m.h5"


def maps(product: Path, place: tuple[slice, slice]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Every default map of a part of the image, and its standard errors."""
    rows, columns = place
    full = MuellerImage.load(product, rows)
    image = replace(
        full,
        values=full.values[..., columns],
        errors=full.errors[..., columns],
        mask=full.mask[:, columns],
        residual_rms=full.residual_rms[:, columns],
    )
    m = image.matrices.astype(float)
    derived_maps = {}
    groups = [gradients.coherency, gradients.depolarization_index, gradients.diattenuation, gradients.polarizance]
    groups += [gradients.dominant, gradients.lu_chipman_quantities, lambda x: gradients.pairs(x, PAPER_PAIRS)]
    for group in groups:
        for name, derived in group(m).items():
            gradients_of_each = derived.gradient.reshape(-1, *m.shape[:2], 16)
            errors = np.sqrt(np.stack([image.variance_of(g) for g in gradients_of_each]))
            derived_maps[name] = derived.value, errors.reshape(derived.value.shape)
    return derived_maps


def test_discs_stand_out_of_the_background(product: Path) -> None:
    disc, background = maps(product, DISC), maps(product, BACKGROUND)
    xi, errors = disc["coherency_eigenvalues"]
    assert (xi[3] > -3 * errors[3]).all()  # physical within the noise
    for name in disc:
        value, error = disc[name]
        assert np.isfinite(value).mean() > 0.99, name
        assert np.isfinite(error).mean() > 0.99, name
        assert (error >= 0).all(), name
    median = {
        name: (np.median(disc[name][0]), np.median(background[name][0])) for name in disc if disc[name][0].ndim == 2
    }
    # The discs depolarize less, polarize more, and are not triply degenerate: xi1 stands out.
    assert median["depolarization_index"][0] > 1.5 * median["depolarization_index"][1]
    missed, missed_error = disc["td_missed"]
    assert 0.015 < np.median(missed) < 0.05
    assert np.median(missed / missed_error) > 5
    assert median["td_missed"][0] > 3 * median["td_missed"][1]
    assert median["crossed_linear"][0] < median["crossed_linear"][1]
    assert median["aligned_linear"][0] > median["aligned_linear"][1]
    # A reflection turns the handedness: its Lu-Chipman retardance is half a turn.
    assert median["retardance_deg"][0] > 160
