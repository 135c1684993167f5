"""The two-coefficient estimate: exactness, error bars, flags, and the cases of docs/conventions.md."""

import numpy as np
import pytest

from processing.errors import ProcessError
from processing.geometry.frames import ScatteringGeometry
from processing.geometry.rusinkiewicz import directions
from processing.instrument.states import rotating_retarders
from processing.polarization import mueller, triply_degenerate
from processing.polarization.xi0 import estimate, xi0_and_m00
from processing.reflectance.base import load_reflectance

HORIZONTAL, VERTICAL = np.array([1.0, 1, 0, 0]) / 2, np.array([1.0, -1, 0, 0]) / 2


def linear_stokes(generator: np.ndarray) -> np.ndarray:
    analyzers = np.array([[1.0, 1, 0, 0], [1, 0, 1, 0], [1, -1, 0, 0], [1, 0, -1, 0]]) / 2
    return (analyzers[:, :, None] * generator).reshape(4, 16)


@pytest.fixture(scope="module")
def red(configs):
    return load_reflectance(configs / "materials/red_print.yaml")


def surface(count: int) -> ScatteringGeometry:
    rng = np.random.default_rng(5)
    angles = rng.uniform([0.05, 0.2, -3.1], [1.1, 0.5, 3.1], size=(count, 3))
    return ScatteringGeometry(*directions(*angles.T))


def measured(m: np.ndarray, w: np.ndarray) -> np.ndarray:
    return np.einsum("kj,...j->k...", w, m.reshape(*m.shape[:-2], 16))


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("states", ["stokes", "40"])
def test_exact_without_noise(red, rgb950, states, weighted):
    m0 = red.mueller_jones(surface(500), 662)
    xi0 = np.linspace(0.25, 1.0, 500)
    m00 = np.linspace(0.1, 2.0, 500)
    w = linear_stokes(VERTICAL)
    if states == "40":
        w = rgb950.rows(rotating_retarders(1.0).angles_deg).reshape(-1, 16)
    p = measured(triply_degenerate.mueller_matrix(m0, xi0, m00), w)
    e = estimate(p, np.ones_like(p) * 1e-8, w, m0, weighted=weighted)
    np.testing.assert_allclose(e.xi0, xi0, atol=1e-11)
    np.testing.assert_allclose(e.m00, m00, atol=1e-11)
    assert e.valid.all()
    assert not e.unphysical.any()


@pytest.mark.parametrize("weighted", [False, True])
def test_quoted_standard_errors_give_pulls_of_unit_variance(red, weighted):
    m0 = np.tile(red.mueller_jones(surface(200), 662), (60, 1, 1))
    w = linear_stokes(HORIZONTAL)
    electrons = 40_000 * measured(triply_degenerate.mueller_matrix(m0, 0.4, 0.5), w)
    variance = electrons + 6.0
    rng = np.random.default_rng(3)
    p = electrons + rng.normal(size=electrons.shape) * np.sqrt(variance)
    e = estimate(p, variance, w, m0, weighted=weighted)
    keep = e.valid
    assert keep.mean() > 0.9
    assert np.std((e.xi0 - 0.4)[keep] / e.xi0_stderr[keep]) == pytest.approx(1, abs=0.03)
    assert np.std((e.m00 / 40_000 - 0.5) / (e.m00_stderr / 40_000)) == pytest.approx(1, abs=0.03)
    if weighted:
        assert np.mean(e.chi_square) == pytest.approx(1, abs=0.03)


def test_the_mask_looks_at_the_noise_and_not_at_xi0(red):
    # Read noise that makes an error near the limit of 0.1, which is less at xi0 = 1 than at 1/4.
    m0 = np.tile(red.mueller_jones(surface(1), 662), (3000, 1, 1))
    w, random = linear_stokes(VERTICAL), np.random.default_rng(8)
    shares = []
    for xi0 in (0.25, 0.6, 1.0):
        p = measured(triply_degenerate.mueller_matrix(m0, xi0), w)
        sigma = 0.034
        e = estimate(p + random.normal(0, sigma, p.shape), np.full_like(p, sigma**2), w, m0)
        shares.append(e.valid.mean())
    assert 0.2 < shares[0] < 0.8
    assert np.ptp(shares) < 0.04


def test_without_variance_the_residual_gives_the_error_bars(red, rgb950):
    w = rgb950.rows(rotating_retarders(1.0).angles_deg).reshape(-1, 16)
    m0 = np.tile(red.mueller_jones(surface(100), 662), (40, 1, 1))
    p = measured(triply_degenerate.mueller_matrix(m0, 0.5), w)
    p = p + np.random.default_rng(4).normal(size=p.shape) * 2e-3
    e = estimate(p, None, w, m0)
    # 38 degrees of freedom: Student's t is 1.027 wide.
    assert np.std((e.xi0 - 0.5) / e.xi0_stderr) == pytest.approx(1.027, abs=0.035)


def test_a_model_turned_by_45_degrees_gives_a_quarter_and_beyond_is_kept_and_flagged():
    # Alpha_0 scales with cos(2 x angle error).
    w = linear_stokes(np.array([1.0, 0, 0, 0]))
    true = mueller.diattenuator(0.0, 1.0, 0.2)
    true = true / true[0, 0]
    turns = np.deg2rad([0.0, 30.0, 45.0, 60.0, 90.0])
    m0 = mueller.rotation(turns) @ true @ mueller.rotation(-turns)
    p = measured(np.broadcast_to(triply_degenerate.mueller_matrix(true, 0.7), m0.shape), w)
    e = estimate(p, np.full_like(p, 1e-10), w, m0)
    alpha_0 = e.m00 * (4 * e.xi0 - 1) / 3
    np.testing.assert_allclose(alpha_0 / alpha_0[0], np.cos(2 * turns), atol=1e-12)
    assert e.xi0[2] == pytest.approx(0.25)
    assert e.unphysical.tolist() == [False, False, False, True, True]
    assert e.valid.all()


def test_no_modulation_is_invalid_and_not_a_number_out_of_thin_air():
    # A retarder does nothing to unpolarized light.
    w = linear_stokes(np.array([1.0, 0, 0, 0]))
    m0 = np.stack([mueller.retarder(0.3, 1.0), np.full((4, 4), np.nan)])
    p = np.full((4, 2), 0.25)
    e = estimate(p, np.full((4, 2), 1e-6), w, m0)
    assert not e.valid.any()
    assert not e.unphysical.any()


@pytest.mark.parametrize("kind", ["depolarizing", "unphysical", "m00"])
def test_a_dominant_process_that_is_no_mueller_jones_matrix_is_refused(red, kind):
    m0 = red.mueller_jones(surface(50), 662)
    wrong = {
        "depolarizing": triply_degenerate.mueller_matrix(m0, 0.8),
        "unphysical": np.tile(np.diag([1.0, 1.0, 1.0, -1.0]), (50, 1, 1)),
        "m00": 1.2 * m0,
    }[kind]
    with pytest.raises(ProcessError, match="no Mueller-Jones matrix"):
        estimate(np.ones((4, 50)), None, linear_stokes(VERTICAL), wrong)
    estimate(np.ones((4, 50)), None, linear_stokes(VERTICAL), m0.astype(np.float32))


def test_horizontal_light_loses_the_estimate_near_brewster_and_vertical_does_not(red):
    # At the specular point, integer degrees of theta_d, 662 nm.
    theta_d = np.deg2rad(np.arange(0.0, 89.0))
    zero = np.zeros_like(theta_d)
    m0 = red.mueller_jones(ScatteringGeometry(*directions(zero, theta_d, zero)), 662)
    ones = np.ones((4, theta_d.size))
    horizontal = estimate(ones, None, linear_stokes(HORIZONTAL), m0).condition
    vertical = estimate(ones, None, linear_stokes(VERTICAL), m0).condition
    assert np.argmax(horizontal) == 52
    assert horizontal[52] == pytest.approx(270, rel=0.03)
    assert vertical.max() < 5


def test_fast_path_equals_the_general_estimate(red):
    m0 = red.mueller_jones(surface(4000), 662).reshape(80, 50, 4, 4)
    w = linear_stokes(HORIZONTAL)
    p = 1000 * measured(triply_degenerate.mueller_matrix(m0, 0.3, 0.5), w)
    p += np.random.default_rng(6).normal(size=p.shape)
    xi0, m00 = xi0_and_m00(p.astype(np.float32), measured(m0, w).astype(np.float32), w[:, 0])
    e = estimate(p, np.ones_like(p), w, m0)
    close = e.condition < 20
    assert close.mean() > 0.95
    np.testing.assert_allclose(xi0[close], e.xi0[close], atol=2e-5)
    np.testing.assert_allclose(m00[close], e.m00[close], rtol=1e-5)


def test_shapes_that_do_not_fit_are_refused(red):
    m0 = red.mueller_jones(surface(3), 662)
    with pytest.raises(ValueError, match="40"):
        estimate(np.ones((4, 3)), None, np.ones((40, 16)), m0)
    with pytest.raises(ValueError, match="weights need"):
        estimate(np.ones((4, 3)), None, np.ones((4, 16)), m0, weighted=True)
