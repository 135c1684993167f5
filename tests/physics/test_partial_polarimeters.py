"""Polarimeters that determine a part of the Mueller matrix: that part with its errors, nothing of the rest."""

import numpy as np
import pytest

from processing.errors import NotDetermined, ProcessError
from processing.instrument.determined import determined_basis, determined_elements
from processing.instrument.model import InstrumentModel
from processing.maps.xi0 import xi0_of_mueller
from processing.reduction.mueller import Choice, reduce_mueller
from processing.storage.capture import Capture
from processing.storage.images import MuellerImage
from processing.storage.pixel_mask import Mask
from processing.storage.product import Product, ProductError, Step

#: Elements that each instrument determines, and angles of its axes that do it.
INSTRUMENTS = {
    "rotating_retarder_stokes": ("m00 m10 m20 m30", {"psa": 22.5 * np.arange(16)}),
    "rotating_analyzer": ("m00 m10 m20", {"psa": 30.0 * np.arange(6)}),
    "linear_mueller": (
        "m00 m01 m02 m10 m11 m12 m20 m21 m22",
        {"psg": np.repeat([0.0, 60, 120, 20], 4), "psa": np.tile([0.0, 60, 120, 100], 4)},
    ),
}
GAIN, READ = 2.0, 3.0
SAMPLE = np.array([[1, 0.2, -0.1, 0.05], [0.15, 0.6, 0.1, -0.2], [-0.3, 0.05, 0.5, 0.1], [0.2, 0.1, -0.15, 0.4]])


def names_of(seen):
    return " ".join(f"m{k // 4}{k % 4}" for k in np.flatnonzero(seen))


@pytest.fixture
def noisy(synthetic_capture, configs):
    """Makes a capture of 30 x 40 pixels of one sample, with its own shot and read noise."""

    def make(name, angles, electrons=20_000.0, top=None):
        model = InstrumentModel.load(configs / f"instruments/{name}.yaml")
        signal = model.rows(angles).reshape(-1, 16) @ SAMPLE.reshape(16) * electrons * 2
        random = np.random.default_rng(4)
        light = random.poisson(signal[:, None, None, None], (len(signal), 1, 30, 40))
        counts = (light + random.normal(0, READ, light.shape)) / GAIN + 100
        frames = np.round(counts).astype(np.uint16)
        if top:
            frames[2, 0, :3] = top
        detector = {"gain_e_per_count": GAIN, "read_noise_e": READ, "black_level_counts": 100, "bits": 16}
        return synthetic_capture(frames, angles, detector=detector), model, electrons * 2 / GAIN

    return make


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("name", INSTRUMENTS)
def test_what_is_determined_is_reported_with_its_error_and_the_rest_is_not(name, weighted, noisy, tmp_path):
    elements, angles = INSTRUMENTS[name]
    path, model, scale = noisy(name, angles)
    seen = determined_elements(determined_basis(model))
    assert names_of(seen) == elements
    with Capture(path) as capture:
        choice = Choice(weighted=weighted, covariance=weighted)
        facts = reduce_mueller(capture, model, tmp_path / "m.h5", (Step("reduce", {}),), choice=choice)
    assert (facts["rank"], facts["determined"].replace(",", "")) == (seen.sum(), elements)
    assert facts["median_reduced_chi_square"] == pytest.approx(1, abs=0.35)
    image = MuellerImage.load(tmp_path / "m.h5")
    values, errors = image.values.reshape(16, -1), image.errors.reshape(16, -1)
    assert np.isnan(values[~seen]).all()
    assert np.isnan(errors[~seen]).all()
    pulls = (values[seen] - scale * SAMPLE.reshape(16, 1)[seen]) / errors[seen]
    count = pulls.shape[1]
    assert np.abs(pulls.mean(axis=1)).max() < 5 / np.sqrt(count)
    # Five standard deviations of the scatter of a standard deviation.
    assert pulls.std(axis=1) == pytest.approx(1, abs=5 / np.sqrt(2 * count))


@pytest.mark.parametrize("weighted", [False, True])
def test_saturated_states_are_left_out_there_too(weighted, noisy, tmp_path):
    path, model, scale = noisy("rotating_retarder_stokes", INSTRUMENTS["rotating_retarder_stokes"][1], top=65535)
    with Capture(path) as capture:
        choice = Choice(weighted=weighted)
        reduce_mueller(capture, model, tmp_path / "m.h5", (Step("reduce", {}),), choice=choice)
    image = MuellerImage.load(tmp_path / "m.h5")
    assert (image.mask[:3] == Mask.SATURATED).all()
    stokes = image.values[:, 0, :3].reshape(4, -1) / scale
    assert stokes.mean(axis=1) == pytest.approx(SAMPLE[:, 0], abs=0.01)


def test_states_that_see_less_than_the_instrument_can_are_refused(noisy, tmp_path):
    path, model, _ = noisy("rotating_retarder_stokes", {"psa": np.array([0.0, 90, 180, 270])})
    with Capture(path) as capture, pytest.raises(NotDetermined, match=r"rank \d, and 4 are needed"):
        reduce_mueller(capture, model, tmp_path / "m.h5", (Step("reduce", {}),))


def test_what_needs_the_whole_matrix_says_so(noisy, tmp_path):
    path, model, _ = noisy("rotating_analyzer", INSTRUMENTS["rotating_analyzer"][1])
    with Capture(path) as capture:
        with pytest.raises(ProcessError, match="3 of 16 numbers"):
            reduce_mueller(capture, model, tmp_path / "p.h5", (Step("reduce", {}),), choice=Choice(physical="nearest"))
        reduce_mueller(capture, model, tmp_path / "m.h5", (Step("reduce", {}),))
    with pytest.raises(ProductError, match="determines m00, m10, m20, and this needs all 16"):
        xi0_of_mueller(tmp_path / "m.h5", tmp_path / "x.h5", Step("xi0", {}), False, None)
    with Product(tmp_path / "m.h5") as product:
        from processing.reports.figures import product_figure

        assert product_figure(product)


def test_five_to_one_needs_steps_over_half_a_turn(configs):
    model = InstrumentModel.load(configs / "instruments/drr_5to1.yaml")
    from processing.instrument.model import rank
    from processing.instrument.states import rotating_retarders

    assert rank(model.rows(rotating_retarders(1.0, 40, 9.0, 5.0).angles_deg)) == 12
    assert rank(model.rows(rotating_retarders(1.0, 30, 6.0, 5.0).angles_deg)) == 16
