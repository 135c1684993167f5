"""What a reader sees in figures: scales that the object decides, and panels that say something."""

import numpy as np
import pytest

from processing.reports import colours, figures
from processing.storage.captures.schema import CaptureHeader
from processing.storage.products.product import Plane, Product
from processing.storage.products.product_writer import ProductWriter


def disc(shape=(80, 80), radius=30):
    y, x = np.indices(shape)
    return np.hypot(y - shape[0] / 2, x - shape[1] / 2), radius


@pytest.mark.parametrize("limb", [0.5, 1.5, 40.0])
def test_artefacts_at_the_limb_do_not_decide_the_scale(limb):
    distance, radius = disc()
    dolp = np.where(distance < radius, 0.02 + 0.23 * np.exp(-((distance / 20) ** 2)), np.nan)
    edge = (distance > radius - 0.6) & (distance < radius)
    assert 0.01 < edge.sum() / np.isfinite(dolp).sum() < 0.06
    clean = colours.upper_end(dolp)
    dolp[edge] = limb
    assert colours.upper_end(dolp) < 2 * clean < 0.6


def test_a_scale_holds_what_is_spread_evenly_and_what_is_nearly_empty():
    assert colours.upper_end(np.linspace(0, 1, 1000)) == pytest.approx(0.995, abs=0.01)
    nearly_empty = np.zeros(1000)
    nearly_empty[:100] = 5.0
    assert colours.upper_end(nearly_empty) == 5.0
    assert colours.upper_end(np.full(5, np.nan)) == 1.0


@pytest.fixture
def xi0_product(tmp_path):
    header = CaptureHeader(title="ball", simulated=True, mode="drr", wavelength_nm=662)
    distance, radius = disc()
    planes = {name: Plane((), "", name) for name in ("eigenvalue_spread", "xi0", "xi0_errors", "valid")}
    with ProductWriter(tmp_path / "b.xi0.h5", "xi0", header, (80, 80), planes=planes, steps=()) as writer:
        valid = (distance < radius).astype(np.float32)
        xi0 = np.where(valid > 0, 0.4, np.nan).astype(np.float32)
        writer.write(slice(0, 80), xi0=xi0, xi0_errors=xi0 * 0 + 0.01, valid=valid, eigenvalue_spread=xi0)
        writer.seal({"warnings": []})
    return tmp_path / "b.xi0.h5"


def test_the_figure_of_xi0_shows_xi0_and_its_error_alone(xi0_product):
    with Product(xi0_product) as product:
        drawn = figures.product_figure(product)
    titles = [axis.get_title() for axis in drawn.axes if axis.get_title()]
    assert len(titles) == 2
    assert "not valid, 56 % of the image" in titles[0]


def test_the_page_of_a_product_opens_on_what_it_is_about(xi0_product):
    from viewer.products import maps_of

    with Product(xi0_product) as product:
        names = [entry["name"] for entry in maps_of(product)]
    assert names[0] == "xi0"
    assert set(names) == {"xi0", "valid", "eigenvalue_spread"}


def test_squares_of_pixels_show_what_the_noise_of_single_pixels_hides():
    from processing.diagnosis.instrument.figures import cell_means, noise_of_cells

    rng = np.random.default_rng(5)
    image = rng.normal(0, 1, (6, 200, 240)) + 0.3 * np.sin(np.arange(240) / 40)
    image[:, :50] = np.nan
    cells = cell_means(image)
    assert cells.shape == (6, 33, 40)
    assert np.isnan(cells[:, :8]).all()
    assert np.isfinite(cells[:, 9:]).all()
    assert noise_of_cells(image) == pytest.approx(1 / 6, rel=0.02)
    pattern = 0.3 * np.sin((np.arange(40) * 6 + 2.5) / 40)
    assert np.corrcoef(cells[0, 10:].mean(axis=0), pattern)[0, 1] > 0.98
    # A point detector: one pixel.
    assert cell_means(np.ones((4, 1, 1))).shape == (4, 1, 1)
    assert noise_of_cells(np.ones((4, 1, 1))) is None
