"""Instruments that no train of ordinary elements describes: a measured W, an elliptical analyzer, a nominal gain."""

import numpy as np
import pytest
import yaml

from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument.structure import correlates_of
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.polarization import mueller
from processing.steps.reduction import Reduction
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Product
from processing.yaml_file import dump_yaml

#: Four elliptical states on the sphere, and eight between them: of a liquid crystal polarimeter, say.
RNG = np.random.default_rng(3)


def states_of(count):
    v = RNG.normal(size=(count, 3))
    return np.hstack([np.ones((count, 1)), 0.95 * v / np.linalg.norm(v, axis=1)[:, None]]) / 2


def measured(rows, **more):
    state = {"angles_deg": {"state": list(range(len(rows)))}, "rows": np.asarray(rows).tolist()}
    return {"kind": "instrument", "name": "lc", "generator": [], "analyzer": [], "measured": state | more}


def capture_of(synthetic_capture, w, m, model, *, order=None, shape=(6, 8), gain=1.0):
    order = np.arange(len(w)) if order is None else order
    signal = (w[order] @ m)[:, None, None, None] * 2e4 * np.ones((1, 1, *shape))
    detector = {"black_level_counts": 0.0, "gain_e_per_count": gain, "read_noise_e": gain, "bits": 16}
    return synthetic_capture(
        np.round(signal).astype(np.uint16),
        {"state": order.astype(float)},
        role=("sample",) * len(order),
        instrument_yaml=dump_yaml(model),
        detector=detector,
        wavelength_nm=600.0,
    )


def test_a_measured_w_reduces_a_mueller_capture_in_any_order(synthetic_capture):
    g, a = states_of(24), states_of(24)
    w = np.einsum("ni,nj->nij", a, g).reshape(24, 16)
    model = InstrumentModel.model_validate(measured(w))
    true = (mueller.retarder(0.4, 1.1) @ mueller.diattenuator(0.2, 1.0, 0.6)).reshape(16)
    path = capture_of(synthetic_capture, w, true, model, order=RNG.permutation(24))
    image = MuellerImage.load(Reduction(path).make())
    m = image.values.mean(axis=(2, 3)).reshape(16)
    assert image.is_determined.all()
    np.testing.assert_allclose(m / m[0], true / true[0], atol=1e-3)


def test_a_measured_w_of_four_numbers_is_a_stokes_polarimeter(synthetic_capture):
    a = states_of(12)
    model = InstrumentModel.model_validate(measured(a))
    light = np.array([1.0, 0.3, -0.2, 0.4])
    path = capture_of(synthetic_capture, a, light, model)
    with Capture(path) as capture:
        assert capture.reduces_to == "mueller"
    image = MuellerImage.load(Reduction(path).make())
    assert image.is_determined.reshape(4, 4).tolist() == [[True, False, False, False]] * 4
    s = image.values.mean(axis=(2, 3))[:, 0]
    np.testing.assert_allclose(s / s[0], light, atol=1e-3)


def test_the_uncertainty_of_a_measured_w_is_that_of_drawn_ones(synthetic_capture):
    rng = np.random.default_rng(8)
    g, a = states_of(24), states_of(24)
    w = np.einsum("ni,nj->nij", a, g).reshape(24, 16)
    true = (mueller.retarder(0.4, 1.1) @ mueller.diattenuator(0.2, 1.0, 0.6)).reshape(16)
    path = capture_of(synthetic_capture, w, true, InstrumentModel.model_validate(measured(w, u=0.004)))
    with Product(Reduction(path).make()) as product:
        stated = product.get("mueller_systematic").mean(axis=(2, 3)).reshape(16) / product.get("mueller")[0, 0].mean()
    drawn = np.array([np.linalg.pinv(w + rng.normal(0, 0.004, w.shape)) @ w @ true for _ in range(3000)])
    spread = (drawn / drawn[:, :1]).std(axis=0)
    np.testing.assert_allclose(stated[1:], spread[1:], rtol=0.08)


def test_a_measured_w_needs_neither_trains_nor_numbers_of_its_states():
    w = states_of(6)
    short = InstrumentModel.model_validate({"name": "lc", "measured": {"rows": w.tolist()}})
    long = InstrumentModel.model_validate(measured(w))
    np.testing.assert_array_equal(short.rows({"state": [4, 0]}), long.rows({"state": [4, 0]}))


@pytest.mark.parametrize("gain", [None, 1.0])
def test_frames_without_noise_are_refused_in_words(synthetic_capture, gain):
    g, a = states_of(20), states_of(20)
    w = np.einsum("ni,nj->nij", a, g).reshape(20, 16)
    model = InstrumentModel.model_validate(measured(w))
    path = capture_of(synthetic_capture, w, np.eye(4).reshape(16), model, shape=(24, 32), gain=gain)
    with pytest.raises(ProcessError, match="its frames have no noise"):
        diagnose_captures([path], model)


def test_a_state_that_was_not_measured_is_refused_by_its_angles():
    model = InstrumentModel.model_validate(measured(states_of(6)))
    with pytest.raises(ProcessError, match=r"state 1 has state 2.5, .*no such state"):
        model.rows({"state": [1.0, 2.5]})
    assert model.rows({"state": [5.05]}).shape == (1, 1, 16)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"analyzer": [{"kind": "polarizer", "name": "p"}]}, "no elements"),
        ({"channels": [{"name": "a"}, {"name": "b"}]}, "one row for each state and channel"),
        ({"measured": {"angles_deg": {"state": [0, 1]}, "rows": [[1, 0, 0]] * 2}}, "16 numbers"),
        ({"measured": {"angles_deg": {"state": [0, 1], "psg": [0]}, "rows": [[1, 0, 0, 0]] * 2}}, "one angle a state"),
    ],
)
def test_a_w_that_fits_nothing_is_refused(change, reason):
    with pytest.raises(ValueError, match=reason):
        InstrumentModel.model_validate(measured(states_of(6)) | change)


def test_an_elliptical_analyzer_transmits_its_own_state_and_no_other():
    """A quarter-wave plate before a linear analyzer transmits an ellipse along the plate."""
    row = (mueller.polarizer(0.3 + 0.5) @ mueller.retarder(0.3, np.pi / 2))[0]
    np.testing.assert_allclose(mueller.polarizer(0.3, 0.0, 0.5)[0], row, atol=1e-12)
    leaky = mueller.polarizer(0.7, 0.02, 0.3)
    state = np.array([1, np.cos(0.6) * np.cos(1.4), np.cos(0.6) * np.sin(1.4), np.sin(0.6)])
    orthogonal = state * [1, -1, -1, -1]
    np.testing.assert_allclose([leaky @ state, leaky @ orthogonal], [state, 0.02 * orthogonal], atol=1e-12)
    np.testing.assert_allclose(mueller.polarizer(0.7, 0.01, 1e-12), mueller.polarizer(0.7, 0.01), atol=1e-11)
    text = "{kind: polarizer, name: e, azimuth_deg: 20, ellipticity_deg: {value: 45, u: 0.5}}"
    model = InstrumentModel.model_validate(
        {"name": "right circular", "generator": [], "analyzer": [yaml.safe_load(text)]}
    )
    np.testing.assert_allclose(model.at(600).rows({})[0, 0, [0, 4, 8, 12]], [0.5, 0, 0, 0.5], atol=1e-12)
    assert model.stderr == {"e.ellipticity_deg": 0.5}


def test_a_gain_has_an_uncertainty_and_can_be_nominal():
    channels = [{"name": "t", "gain": {"value": 1.02, "u": 0.01}}, {"name": "r"}]
    model = InstrumentModel.model_validate(
        {"name": "two beams", "generator": [], "analyzer": [], "channels": channels, "calibrate": ["r.gain"]}
    )
    assert (model.channels[0].gain, model.stderr, model.value_of("r.gain")) == (1.02, {"t.gain": 0.01}, 1.0)


def test_a_residual_that_is_equal_everywhere_correlates_with_nothing():
    """The mean of 600 times this number rounds to another one: its standard deviation is not zero."""
    numbers = np.linspace(1, 2, 500, dtype=np.float32)
    number = next(x for x in numbers if np.full(600, np.sqrt(x * x)).std() > 0)
    residual = np.full((1, 20, 30), number, dtype=np.float32)
    signal = np.broadcast_to(np.arange(30, dtype=np.float32), residual.shape)
    assert correlates_of(residual, signal, np.ones((20, 30), dtype=bool)) == {}
