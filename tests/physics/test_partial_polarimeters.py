"""Polarimeters that determine a part of the Mueller matrix: that part with its errors, nothing of the rest."""

import re

import numpy as np
import pytest

from processing.calibration.known_sample import part_of
from processing.calibration.train import fit_trains
from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.errors import NotDetermined, ProcessError
from processing.instrument.determined_basis import determined_basis, determined_elements
from processing.instrument.model import InstrumentModel, Polarizer
from processing.maps import xi0 as maps
from processing.maps.means import mean_of
from processing.maps.quantities import quantities_of_mueller
from processing.maps.tables import tabulate
from processing.maps.xi0 import xi0_of_mueller
from processing.polarization import mueller
from processing.polarization.triply_degenerate import mueller_matrix
from processing.reduction.mueller import reduce_mueller
from processing.reduction.mueller_reduction import Choice
from processing.reflectance.base import normalized_mueller
from processing.reports.figures import product_figure
from processing.steps.maps import Xi0
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.formats.axostep_product import axostep_of_product
from processing.storage.products.images import MuellerImage
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Product, ProductError, Step
from processing.yaml_file import dump_yaml

#: Elements that each instrument determines, and angles of its axes that do it.
INSTRUMENTS = {
    "rotating_retarder_stokes": ("m00 m10 m20 m30", {"psa": 22.5 * np.arange(16)}),
    "rotating_analyzer": ("m00 m10 m20", {"psa": 30.0 * np.arange(6)}),
    "linear_mueller": (
        "m00 m01 m02 m10 m11 m12 m20 m21 m22",
        {"psg": np.repeat([0.0, 60, 120, 20], 4), "psa": np.tile([0.0, 60, 120, 100], 4)},
    ),
}
ELECTRONS, GAIN, READ = 20_000.0, 2.0, 3.0
#: Counts of an unpolarized sample that sends all light on.
SCALE = 2 * ELECTRONS / GAIN
STEPS = (Step("reduce", {}),)
SAMPLE = np.array([[1, 0.2, -0.1, 0.05], [0.15, 0.6, 0.1, -0.2], [-0.3, 0.05, 0.5, 0.1], [0.2, 0.1, -0.15, 0.4]])


def names_of(is_determined):
    return " ".join(f"m{k // 4}{k % 4}" for k in np.flatnonzero(is_determined))


@pytest.fixture
def noisy(synthetic_capture, configs):
    """Makes a capture of 30 x 40 pixels of one sample, with its own shot and read noise."""

    def make(name, angles, top=None, sample=SAMPLE, sent_deg=None):
        model = InstrumentModel.load(configs / f"instruments/{name}.yaml")
        if sent_deg is not None:
            sent = Polarizer(kind="polarizer", name="sent", azimuth_deg=sent_deg)
            model = model.model_copy(update={"generator": (sent,)})
        signal = model.rows(angles).reshape(-1, 16) @ sample.reshape(16) * ELECTRONS * 2
        random = np.random.default_rng(4)
        light = random.poisson(signal[:, None, None, None], (len(signal), 1, 30, 40))
        counts = (light + random.normal(0, READ, light.shape)) / GAIN + 100
        frames = np.round(counts).astype(np.uint16)
        if top:
            frames[2, 0, :3] = top
        detector = {"gain_e_per_count": GAIN, "read_noise_e": READ, "black_level_counts": 100, "bits": 16}
        return synthetic_capture(frames, angles, detector=detector), model

    return make


def reduced(noisy_capture, out, **choice):
    """Reduce a capture of `noisy`; return the facts of the product."""
    path, model = noisy_capture
    with Capture(path) as capture:
        return reduce_mueller(capture, model, out, STEPS, choice=Choice(**choice))


@pytest.mark.parametrize(("name", "weighted"), [*((name, False) for name in INSTRUMENTS), ("linear_mueller", True)])
def test_what_is_determined_is_reported_with_its_error_and_the_rest_is_not(name, weighted, noisy, tmp_path):
    elements, angles = INSTRUMENTS[name]
    path, model = noisy(name, angles)
    is_determined = determined_elements(determined_basis(model))
    assert names_of(is_determined) == elements
    facts = reduced((path, model), tmp_path / "m.h5", weighted=weighted, covariance=weighted)
    assert (facts["rank"], facts["determined"].replace(",", "")) == (is_determined.sum(), elements)
    assert facts["median_reduced_chi_square"] == pytest.approx(1, abs=0.35)
    image = MuellerImage.load(tmp_path / "m.h5")
    values, errors = image.values.reshape(16, -1), image.errors.reshape(16, -1)
    assert np.isnan(values[~is_determined]).all()
    assert np.isnan(errors[~is_determined]).all()
    pulls = (values[is_determined] - SCALE * SAMPLE.reshape(16, 1)[is_determined]) / errors[is_determined]
    count = pulls.shape[1]
    assert np.abs(pulls.mean(axis=1)).max() < 5 / np.sqrt(count)
    # Five standard deviations of the scatter of a standard deviation.
    assert pulls.std(axis=1) == pytest.approx(1, abs=5 / np.sqrt(2 * count))


@pytest.mark.parametrize("weighted", [False, True])
def test_saturated_states_are_left_out_there_too(weighted, noisy, tmp_path):
    capture = noisy("rotating_retarder_stokes", INSTRUMENTS["rotating_retarder_stokes"][1], top=65535)
    reduced(capture, tmp_path / "m.h5", weighted=weighted)
    image = MuellerImage.load(tmp_path / "m.h5")
    assert (image.mask[:3] == Mask.SATURATED).all()
    stokes = image.values[:, 0, :3].reshape(4, -1) / SCALE
    assert stokes.mean(axis=1) == pytest.approx(SAMPLE[:, 0], abs=0.01)


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_quantities_are_those_that_the_elements_give(name, noisy, tmp_path):
    reduced(noisy(name, INSTRUMENTS[name][1]), tmp_path / "m.h5")
    quantities_of_mueller(tmp_path / "m.h5", tmp_path / "q.h5", Step("quantities", {}))
    truth = {
        "diattenuation_linear": np.hypot(0.2, 0.1),
        "polarizance_linear": np.hypot(0.15, 0.3),
        "polarizance": np.linalg.norm([0.15, 0.3, 0.2]),
        "polarizance_circular": 0.2,
        "polarizance_orientation_deg": np.rad2deg(np.arctan2(-0.3, 0.15)) / 2 + 180,
        "crossed_linear": (1 - 0.2 + 0.15 - 0.6) / 2,
        "aligned_linear": (1 - 0.2 - 0.15 + 0.6) / 2,
        "dop": np.linalg.norm([0.15, 0.3, 0.2]),
        "dolp": np.hypot(0.15, 0.3),
        "docp": 0.2,
        "aolp_deg": np.rad2deg(np.arctan2(-0.3, 0.15)) / 2 + 180,
        "ellipticity_deg": np.rad2deg(np.arctan2(0.2, np.hypot(0.15, 0.3))) / 2,
    }
    quantities = {
        "rotating_retarder_stokes": {"dop", "dolp", "docp", "aolp_deg", "ellipticity_deg"},
        "rotating_analyzer": {"dolp", "aolp_deg"},
        "linear_mueller": {"polarizance_linear", "diattenuation_linear", "crossed_linear", "aligned_linear"}
        | {"polarizance_orientation_deg"},
    }[name]
    with Product(tmp_path / "q.h5") as product:
        assert truth.keys() & set(product.names) == quantities
        assert not [name_of_map for name_of_map in product.names if "eigen" in name_of_map or "retard" in name_of_map]
        assert ("polarizance" in " ".join(product.names)) == (name == "linear_mueller")
        for quantity in quantities:
            pulls = (product.get(quantity) - truth[quantity]) / product.get(f"{quantity}_errors")
            assert abs(pulls.mean()) < 5 / np.sqrt(pulls.size)
            assert pulls.std() == pytest.approx(1, abs=5 / np.sqrt(2 * pulls.size))
        with pytest.raises(ProductError, match="needs all 16"):
            quantities_of_mueller(tmp_path / "m.h5", tmp_path / "e.h5", Step("quantities", {}), ("differential",))


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_xi0_comes_with_a_model_of_the_dominant_process(name, noisy, tmp_path, monkeypatch):
    xi0, jones = 0.6, np.array([[1.0, 0.1], [0.2j, -0.6]])
    m0 = normalized_mueller(jones)
    reduced(noisy(name, INSTRUMENTS[name][1], sample=np.asarray(mueller_matrix(m0, xi0, 1.0))), tmp_path / "m.h5")
    monkeypatch.setattr(maps, "dominant_model", lambda *_: np.tile(m0, (30, 40, 1, 1)))
    maps.xi0_of_partial(
        tmp_path / "m.h5", "geometry", "material", tmp_path / "x.h5", step=Step("xi0", {}), overwrite=False
    )
    with Product(tmp_path / "x.h5") as product:
        pulls = (product.get("xi0") - xi0) / product.get("xi0_errors")
    assert abs(pulls.mean()) < 5 / np.sqrt(pulls.size)
    assert pulls.std() == pytest.approx(1, abs=5 / np.sqrt(2 * pulls.size))
    with pytest.raises(ProcessError, match="give --geometry FILE and --material FILE"):
        Xi0(tmp_path / "m.h5").make()


@pytest.mark.parametrize("name", ["rotating_retarder_stokes", "rotating_analyzer"])
def test_polarized_light_gives_the_stokes_vector_that_is_sent_back_and_xi0(name, noisy, tmp_path, monkeypatch):
    m0, xi0 = normalized_mueller(np.array([[1.0, 0.1], [0.2j, -0.6]])), 0.6
    sample = np.asarray(mueller_matrix(m0, xi0, 1.0))
    facts = reduced(noisy(name, INSTRUMENTS[name][1], sample=sample, sent_deg=20.0), tmp_path / "m.h5")
    count = facts["rank"]
    assert facts["determined"].startswith(", ".join(f"S{k}" for k in range(count)) + " of the light")
    with pytest.raises(ProductError, match=r"needs all 16 elements\. With a model"):
        quantities_of_mueller(tmp_path / "m.h5", tmp_path / "q.h5", Step("quantities", {}), ["symmetric"])
    light = np.array([0.5, 0.5 * np.cos(np.deg2rad(40)), 0.5 * np.sin(np.deg2rad(40)), 0])
    with Product(tmp_path / "m.h5") as product:
        stokes, errors = (product.get(plane).reshape(4, -1) for plane in ("stokes", "stokes_errors"))
        assert product_figure(product)
    # For a light of intensity 1.
    pulls = (stokes - SCALE * (sample @ light / 0.5)[:, None]) / errors
    assert np.isnan(pulls[count:]).all()
    assert np.abs(pulls[:count].mean(axis=1)).max() < 5 / np.sqrt(pulls.shape[1])
    assert pulls[:count].std(axis=1) == pytest.approx(1, abs=5 / np.sqrt(2 * pulls.shape[1]))
    monkeypatch.setattr(maps, "dominant_model", lambda *_: np.tile(m0, (30, 40, 1, 1)))
    maps.xi0_of_partial(
        tmp_path / "m.h5", "geometry", "material", tmp_path / "x.h5", step=Step("xi0", {}), overwrite=False
    )
    with Product(tmp_path / "x.h5") as product:
        pulls = (product.get("xi0") - xi0) / product.get("xi0_errors")
    assert pulls.std() == pytest.approx(1, abs=5 / np.sqrt(2 * pulls.size))


@pytest.mark.parametrize(("name", "weighted"), [("rotating_retarder_stokes", True), ("rotating_analyzer", False)])
def test_polarized_light_has_maps_of_what_the_sample_sends_back(name, weighted, noisy, tmp_path):
    sample = np.asarray(mueller_matrix(normalized_mueller(np.array([[1.0, 0.1], [0.2j, -0.6]])), 0.6, 1.0))
    reduced(noisy(name, INSTRUMENTS[name][1], sample=sample, sent_deg=20.0), tmp_path / "m.h5", weighted=weighted)
    facts = quantities_of_mueller(tmp_path / "m.h5", tmp_path / "q.h5", Step("quantities", {}))
    assert "lit in one polarized state" in facts["warnings"][0]
    s = sample @ [1, np.cos(np.deg2rad(40)), np.sin(np.deg2rad(40)), 0]
    dolp = np.hypot(s[1], s[2]) / s[0]
    truth = {"dolp": dolp, "aolp_deg": np.rad2deg(np.arctan2(s[2], s[1])) / 2 % 180}
    if name == "rotating_retarder_stokes":
        truth |= {"dop": np.hypot(dolp, s[3] / s[0]), "docp": s[3] / s[0]}
        truth["ellipticity_deg"] = np.rad2deg(np.arctan2(s[3] / s[0], dolp)) / 2
    with Product(tmp_path / "q.h5") as product:
        extras = {f"{map_}_95" for map_ in truth} | {"stokes_covariance"}
        assert set(product.names) == {"lit", "stokes", *truth, *(f"{m}_errors" for m in ("stokes", *truth)), *extras}
        assert product.get("lit").all()
        for map_, true in truth.items():
            pulls = (product.get(map_) - true) / product.get(f"{map_}_errors")
            assert abs(pulls.mean()) < 5 / np.sqrt(pulls.size), map_
            assert pulls.std() == pytest.approx(1, abs=5 / np.sqrt(2 * pulls.size)), map_
        assert product_figure(product)


@pytest.mark.parametrize("sent_deg", [None, 20.0])
def test_the_covariance_of_the_stokes_vector_is_that_of_its_scatter(sent_deg, noisy, tmp_path):
    angles = {"psa": np.array([-51.7, -15.1, 15.1, 51.7, 20.0, 70.0])}
    reduced(noisy("rotating_retarder_stokes", angles, sent_deg=sent_deg), tmp_path / "m.h5")
    quantities_of_mueller(tmp_path / "m.h5", tmp_path / "q.h5", Step("quantities", {}))
    with Product(tmp_path / "q.h5") as product:
        packed = product.get("stokes_covariance").reshape(10, -1).mean(axis=1)
        stokes = product.get("stokes").reshape(4, -1)
        errors = product.get("stokes_errors").reshape(4, -1)
    scatter = np.cov(stokes)
    covariance = np.diag(packed[:4])
    covariance[np.triu_indices(4, 1)] = packed[4:]
    covariance += np.triu(covariance, 1).T
    assert np.sqrt(packed[:4]) == pytest.approx(errors.mean(axis=1), rel=0.01)
    spread = np.sqrt(np.outer(np.diag(scatter), np.diag(scatter)) / stokes.shape[1])
    assert np.abs((covariance - scatter) / spread).max() < 6
    # States at unequal angles: some of it is no diagonal.
    assert np.abs(np.triu(covariance, 1) / np.sqrt(np.outer(packed[:4], packed[:4]))).max() > 0.1


@pytest.mark.parametrize(
    ("vector", "sent_deg"),
    [((0, 0, 1.0), None), ((0, 0, -0.3), 20.0), ((0.3, 0, 0), None), ((0, 0.01, 0.005), None), ((0, 0, 0), 20.0)],
)
def test_the_ellipticity_is_in_its_interval_for_any_light(vector, sent_deg, noisy, tmp_path):
    sample = np.zeros((4, 4))
    sample[:, 0] = 1, *vector
    capture = noisy("rotating_retarder_stokes", {"psa": 22.5 * np.arange(16)}, sample=sample, sent_deg=sent_deg)
    reduced(capture, tmp_path / "m.h5")
    quantities_of_mueller(tmp_path / "m.h5", tmp_path / "q.h5", Step("quantities", {}))
    truth = np.rad2deg(np.arctan2(vector[2], np.hypot(*vector[:2]))) / 2
    with Product(tmp_path / "q.h5") as product:
        (low, high), value = product.get("ellipticity_deg_95"), product.get("ellipticity_deg")
    assert (low >= -45).all()
    assert (high <= 45).all()
    inside = np.mean((low - 1e-3 <= truth) & (truth <= high + 1e-3))
    # 1200 pixels scatter by 0.6 %; an interval that also holds the end of the range holds more than 95 %.
    assert inside > 0.95 - 5 * 0.0063
    assert (value >= low).all()
    assert (value <= high).all()


@pytest.mark.parametrize("sent_deg", [None, 20.0])
def test_the_mean_of_a_stokes_polarimeter_has_the_names_of_light(sent_deg, noisy, tmp_path):
    sample = np.zeros((4, 4))
    sample[:, 0] = 1, 0.3, 0.2, -0.4
    capture = noisy("rotating_retarder_stokes", {"psa": 22.5 * np.arange(16)}, sample=sample, sent_deg=sent_deg)
    reduced(capture, tmp_path / "m.h5")
    means = {mean.name: mean for mean in mean_of([tmp_path / "m.h5"], (slice(0, 30), slice(0, 40)))}
    truth = {"s1_over_s0": 0.3, "s2_over_s0": 0.2, "s3_over_s0": -0.4, "dolp": np.hypot(0.3, 0.2), "docp": -0.4}
    truth |= {"dop": np.sqrt(0.29), "aolp_deg": np.rad2deg(np.arctan2(0.2, 0.3)) / 2}
    truth["ellipticity_deg"] = np.rad2deg(np.arctan2(-0.4, np.hypot(0.3, 0.2))) / 2
    assert means.keys() == {"s0", *truth}
    for name, true in truth.items():
        assert abs(means[name].value - true) < 4 * means[name].u, name


@pytest.mark.parametrize("name", ["rotating_analyzer", "linear_mueller"])
def test_an_uncertain_instrument_leaves_the_noise_of_a_mean_as_it_is(name, noisy, tmp_path):
    path, model = noisy(name, INSTRUMENTS[name][1])
    means = []
    for k, stderr in enumerate([{}, {"analyzer.azimuth_deg": 0.5}]):
        reduced((path, model.model_copy(update={"stderr": stderr})), tmp_path / f"{k}.h5")
        means.append({m.name: m for m in mean_of([tmp_path / f"{k}.h5"], (slice(0, 30), slice(0, 40)))})
    certain, uncertain = means
    assert certain.keys() == uncertain.keys()
    for quantity, mean in certain.items():
        moved = uncertain[quantity]
        assert moved.u_noise == pytest.approx(mean.u_noise, rel=1e-6), quantity
        # The interval is that of the noise, wider by the instrument's share once.
        if mean.low > 0:
            wider = np.hypot(mean.value - mean.low, 1.96 * moved.u_systematic)
            assert moved.value - moved.low == pytest.approx(wider, rel=1e-3), quantity
    assert np.mean([m.u_systematic > m.u_noise for m in uncertain.values()]) > 0.5


def titles(product):
    return [panel.get_title() for panel in product_figure(product).axes if panel.get_title()]


def test_a_stokes_polarimeter_has_a_figure_of_the_stokes_vector(noisy, tmp_path):
    name = "rotating_retarder_stokes"
    reduced(noisy(name, INSTRUMENTS[name][1]), tmp_path / "m.h5")
    with Product(tmp_path / "m.h5") as product:
        shown = " ".join(titles(product))
    assert re.findall(r"S_\d / S_0", shown) == ["S_1 / S_0", "S_2 / S_0", "S_3 / S_0"]
    for quantity in (
        "degree of polarization",
        "linear pol",
        "circular pol",
        "angle of linear",
        "ellipticity",
        "sphere",
    ):
        assert quantity in shown
    assert "m_" not in shown


def test_the_figure_of_a_partial_mueller_image_says_what_is_not_determined(noisy, tmp_path):
    reduced(noisy("linear_mueller", INSTRUMENTS["linear_mueller"][1]), tmp_path / "m.h5")
    with Product(tmp_path / "m.h5") as product:
        texts = [text.get_text() for panel in product_figure(product).axes for text in panel.texts]
    assert texts.count("not\ndetermined") == 7


def test_states_that_see_less_than_the_instrument_can_are_refused(noisy, tmp_path):
    capture = noisy("rotating_retarder_stokes", {"psa": np.array([0.0, 90, 180, 270])})
    with pytest.raises(NotDetermined, match=r"rank \d, and 4 are needed") as refusal:
        reduced(capture, tmp_path / "m.h5")
    # Nothing of elements that it never sees, nor of angles of two retarders.
    assert "m30" in str(refusal.value)
    assert not any(word in str(refusal.value) for word in ("m01", "4.91"))


def test_what_needs_the_whole_matrix_says_so(noisy, configs, tmp_path):
    capture = noisy("rotating_analyzer", INSTRUMENTS["rotating_analyzer"][1])
    with pytest.raises(ProcessError, match="3 of 16 numbers"):
        reduced(capture, tmp_path / "p.h5", physical="nearest")
    reduced(capture, tmp_path / "m.h5")
    with pytest.raises(ProductError, match="determines m00, m10, m20, and this needs all 16"):
        xi0_of_mueller(tmp_path / "m.h5", tmp_path / "x.h5", Step("xi0", {}), False, progress=None)
    for refused in (
        lambda: tabulate([tmp_path / "m.h5"], configs / "geometries/one_inch_sphere.yaml", "degree"),
        lambda: axostep_of_product(tmp_path / "m.h5", tmp_path / "m.cmmi", False),
    ):
        with pytest.raises(ProductError, match="needs all 16"):
            refused()
    with Product(tmp_path / "m.h5") as product:
        assert product_figure(product)


@pytest.mark.parametrize("name", ["linear_mueller", "polarization_camera_retarder"])
def test_a_known_sample_calibrates_the_train(name, synthetic_capture, configs):
    nominal = InstrumentModel.load(configs / f"instruments/{name}.yaml")
    angles = {"psa": np.tile(22.5 * np.arange(8), 2), "psg": np.repeat([0.0, 60.0], 8)}
    angles = {axis: angles[axis] for axis in nominal.axes}
    element = nominal.analyzer[0].name
    polarizer = 2 * np.asarray(mueller.polarizer(np.array(0.3)))
    signal = nominal.with_values({element: {"azimuth_deg": 1.5}}).rows(angles) @ polarizer.reshape(16) * 20_000
    frames = np.zeros((len(signal), 1, 20, 20))
    for row, line in enumerate(nominal.mosaic or (("camera",),)):
        for column, channel in enumerate(line):
            number = [c.name for c in nominal.channels].index(channel)
            frames[:, 0, row :: nominal.pitch, column :: nominal.pitch] = signal[:, number, None, None]
    counts = np.random.default_rng(1).poisson(frames + 100).astype(np.uint16)
    sample = {"kind": "mueller", "mueller": tuple(polarizer.reshape(16))}
    detector = {"black_level_counts": 100, "bits": 16}
    path = synthetic_capture(
        counts, angles, sample=sample, detector=detector, mosaic=nominal.mosaic, instrument_yaml=dump_yaml(nominal)
    )
    with Capture(path, by_super_pixel=True) as capture:
        part = part_of(capture, nominal, slice(None), slice(None))
    (fit,) = fit_trains([part], [f"{element}.azimuth_deg"])
    assert fit.values[0] == pytest.approx(1.5, abs=5 * fit.stderr[0])
    assert fit.stderr[0] < 0.1


def test_a_sample_that_does_not_see_the_train_does_not_calibrate_it(synthetic_capture, configs):
    # Unpolarized light through air is the same for every angle of the plate.
    nominal = InstrumentModel.load(configs / "instruments/rotating_retarder_stokes.yaml")
    frames = np.full((8, 1, 8, 8), 5000, dtype=np.uint16)
    path = synthetic_capture(frames, {"psa": 22.5 * np.arange(8)}, sample={"kind": "air"})
    with Capture(path) as capture:
        part = part_of(capture, nominal, slice(None), slice(None))
    with pytest.raises(NotDetermined, match="look the same whatever"):
        fit_trains([part], ["psa_retarder.azimuth_deg"])


def test_as_many_states_as_unknowns_leave_nothing_to_diagnose(noisy):
    path, model = noisy("rotating_retarder_stokes", {"psa": np.array([-51.7, -15.1, 15.1, 51.7])})
    with pytest.raises(CaptureError, match="Take more states"):
        diagnose_captures([path], model)
