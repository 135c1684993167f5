"""Quantities of a Mueller matrix: analytic cases, physical ranges, rotation of the frames."""

from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from random_matrices import random_mueller

from processing.errors import ProcessError
from processing.polarization import mueller, quantities, scalar_files, triply_degenerate
from processing.polarization.cloude import coherency_eigenvalues, xi0_and_dominant
from processing.polarization.quantities import PAPER_PAIRS, POLARIZATIONS, between
from processing.polarization.scalar_files import scalar_quantities

Array = NDArray[np.float64]


def test_depolarization_index_and_entropy_of_known_matrices() -> None:
    pure, ideal = mueller.retarder(0.3, 1.1) @ mueller.diattenuator(0.2, 1.0, 0.1), mueller.IDEAL_DEPOLARIZER
    np.testing.assert_allclose(quantities.depolarization_index(np.stack([5 * pure, ideal])), [1, 0], atol=1e-14)
    np.testing.assert_allclose(quantities.entropy(np.array([[1.0, 0, 0, 0], [0.25] * 4])), [0, 1], atol=1e-14)
    half = coherency_eigenvalues(np.diag([1.0, 1, 0, 0]))  # two processes of equal weight
    np.testing.assert_allclose(quantities.entropy(half), 0.5, atol=1e-12)
    assert np.isnan(quantities.entropy(np.array([0.6, 0.3, 0.11, -0.01])))


@pytest.mark.parametrize("xi0", [0.05, 0.2, 0.25, 0.6, 1.0])
def test_triply_degenerate_depolarization_index(xi0: float) -> None:
    # |4 xi0 - 1| / 3, not monotonic below 1/4.
    m = triply_degenerate.mueller_matrix(2 * mueller.polarizer(0.4), xi0, 3.0)
    np.testing.assert_allclose(quantities.depolarization_index(m), abs(4 * xi0 - 1) / 3, atol=1e-8)


@pytest.mark.parametrize("xi0", [0.3, 0.7, 0.99])
def test_depolarization_lowers_diattenuation_by_its_factor_exactly(xi0: float) -> None:
    # docs/conventions.md, "Below a quarter"
    m0 = mueller.diattenuator(0.4, 1.0, 0.3) / 0.65
    m = triply_degenerate.mueller_matrix(m0, xi0)
    before = quantities.linear_magnitude(quantities.diattenuation_vector(m0))
    after = quantities.linear_magnitude(quantities.diattenuation_vector(m))
    np.testing.assert_allclose(after / before, (4 * xi0 - 1) / 3, rtol=1e-12)


def test_deviation_from_td() -> None:
    xi = np.array([0.7, 0.16, 0.09, 0.05])
    np.testing.assert_allclose(quantities.deviation_from_td(xi), [0.06, -0.01, -0.05], atol=1e-15)
    np.testing.assert_allclose(quantities.td_missed(xi), 0.06)
    td = triply_degenerate.mueller_matrix(2 * mueller.polarizer(0.4), 0.7)
    np.testing.assert_allclose(quantities.td_missed(coherency_eigenvalues(td)), 0, atol=1e-14)


@pytest.mark.parametrize("angle_deg", [0.0, 20.0, 45.0, 90.0, 170.0])
def test_diattenuation_and_polarizance_of_a_polarizer(angle_deg: float) -> None:
    m = mueller.rotation(0.4) @ mueller.polarizer(np.deg2rad(angle_deg), 0.2)
    d, p = quantities.diattenuation_vector(m), quantities.polarizance_vector(m)
    for vector, azimuth_deg in ((d, angle_deg), (p, angle_deg + np.rad2deg(0.4))):
        np.testing.assert_allclose(quantities.magnitude(vector), 0.8 / 1.2)
        np.testing.assert_allclose(quantities.linear_magnitude(vector), 0.8 / 1.2)
        difference = np.rad2deg(quantities.orientation(vector)) - azimuth_deg
        np.testing.assert_allclose((difference + 90) % 180 - 90, 0, atol=1e-9)


def test_circular_diattenuation() -> None:
    # A quarter wave plate at 45 degrees, a horizontal polarizer behind it: passes one hand only.
    m = mueller.polarizer(0.0) @ mueller.retarder(np.pi / 4, np.pi / 2)
    d = quantities.diattenuation_vector(m)
    np.testing.assert_allclose(d, [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(between(m, "left", "horizontal"), 1, atol=1e-15)
    np.testing.assert_allclose(between(m, "right", "horizontal"), 0, atol=1e-15)


@settings(max_examples=60, deadline=None)
@given(st.floats(-2, 2), st.floats(1e-6, np.pi - 1e-6))
def test_retardance_vector_of_linear_retarders(azimuth: float, retardance: float) -> None:
    vector = quantities.retardance_vector(mueller.retarder(azimuth, retardance))
    expected = retardance * np.array([np.cos(2 * azimuth), np.sin(2 * azimuth), 0])
    np.testing.assert_allclose(vector, expected, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([1e-9, 1e-4, 0.1, 2.0, 2.2, 3.0, np.pi - 1e-5, np.pi]))
def test_retardance_vector_of_any_rotation(seed: int, angle: float) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    axis /= np.linalg.norm(axis)
    # Phase kz - wt decreases with time, so the slow state gains phase: exp(-i angle/2) on the fast state, axis.
    jones = np.cos(angle / 2) * np.eye(2) - 1j * np.sin(angle / 2) * np.einsum("k,kij->ij", axis, mueller.PAULI[1:])
    vector = quantities.retardance_vector(mueller.from_jones(jones))
    np.testing.assert_allclose(quantities.magnitude(vector), angle, atol=1e-8)
    sign = np.sign(vector @ axis) if angle == np.pi else 1.0
    np.testing.assert_allclose(vector, sign * angle * axis, atol=1e-7)


def test_rotation_of_linear_polarization_is_circular_retardance() -> None:
    # Turning by t counter-clockwise: left circular is fast, by 2 t.
    np.testing.assert_allclose(quantities.retardance_vector(mueller.rotation(0.2)), [0, 0, -0.4], atol=1e-15)


def test_light_between_two_polarizers() -> None:
    air = np.eye(4)
    assert between(air, "unpolarized", "horizontal") == 0.5
    assert between(air, "vertical", "horizontal") == 0
    assert between(mueller.IDEAL_MIRROR, "left", "right") == 1  # a mirror turns the hand
    assert between(mueller.IDEAL_DEPOLARIZER, "left", "right") == 0.5
    m = random_mueller(1, 0)[0]
    for generator, analyzer in PAPER_PAIRS.values():
        light, passed = POLARIZATIONS[generator], POLARIZATIONS[analyzer]
        by_polarizer = (0.5 * np.outer(passed, passed) @ m @ light)[0]
        np.testing.assert_allclose(between(m, generator, analyzer), by_polarizer)
    np.testing.assert_allclose(between(m, [2, 1, 0, 0], "45"), between(m, [1, 0.5, 0, 0], [3, 0, 3, 0]))
    with pytest.raises(ValueError, match="generator 'up' is no polarization; known: unpolarized, horizontal"):
        between(m, "up", "left")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="degree of polarization"):
        between(m, [1, 1, 1, 0], "left")


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.05, 6))
def test_physical_matrices_stay_in_their_ranges(seed: int, spread: float) -> None:
    m = random_mueller(20, seed, spread)
    xi = coherency_eigenvalues(m)
    di = quantities.depolarization_index(m)
    assert ((di >= 0) & (di <= 1 + 1e-12)).all()
    # The index from the eigenvalues is another road to the same number.
    np.testing.assert_allclose(di, np.sqrt((4 * np.sum(xi**2, axis=-1) - 1) / 3), atol=1e-12)
    inside = xi.min(axis=-1) >= 0
    s = quantities.entropy(xi)[inside]
    assert ((s >= 0) & (s <= 1 + 1e-12)).all()
    for vector in (quantities.diattenuation_vector(m), quantities.polarizance_vector(m)):
        assert (quantities.magnitude(vector) <= 1 + 1e-12).all()
    missed = quantities.td_missed(xi)
    assert ((missed >= 0) & (missed <= 2 / 3 * (1 - xi[:, 0]) + 1e-12)).all()
    for generator in POLARIZATIONS:
        for analyzer in POLARIZATIONS:
            fraction = between(m, generator, analyzer) / m[:, 0, 0]  # type: ignore[arg-type]
            assert ((fraction >= -1e-12) & (fraction <= 2 + 1e-12)).all()


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31), st.floats(-3, 3), st.floats(-3, 3))
def test_turning_the_frames(seed: int, before: float, after: float) -> None:
    m = random_mueller(5, seed)
    turned = mueller.rotation(after) @ m @ mueller.rotation(-before)
    for f in (quantities.depolarization_index, lambda x: quantities.td_missed(coherency_eigenvalues(x))):
        np.testing.assert_allclose(f(turned), f(m), atol=1e-10)
    for vector, angle in ((quantities.diattenuation_vector, before), (quantities.polarizance_vector, after)):
        old, new = vector(m), vector(turned)
        np.testing.assert_allclose(quantities.linear_magnitude(new), quantities.linear_magnitude(old), atol=1e-12)
        np.testing.assert_allclose(new[:, 2], old[:, 2], atol=1e-12)
        error = quantities.orientation(new) - quantities.orientation(old) - angle
        weight = quantities.linear_magnitude(old)
        np.testing.assert_allclose(weight * np.sin(2 * error), 0, atol=1e-11)


def test_dominant_process_of_a_depolarized_retarder_keeps_its_diattenuation() -> None:
    m0 = mueller.retarder(0.3, 1.0) @ mueller.diattenuator(0.7, 1.0, 0.2) / 0.6
    dominant = xi0_and_dominant(triply_degenerate.mueller_matrix(m0, 0.4, 9.0))[1]
    d, d0 = quantities.diattenuation_vector(dominant), quantities.diattenuation_vector(m0)
    np.testing.assert_allclose(d, d0, atol=1e-14)


def test_the_components_of_purity_make_up_the_depolarization_index() -> None:
    # Gil, JOSA A 28, 1578 (2011): P_delta^2 = 2/3 P_P^2 + P_S^2; a retarder is all sphere, a polarizer all polarizance.
    scalars = scalar_quantities()
    m = np.random.default_rng(5).normal(size=(50, 4, 4)) * 0.2 + 3 * np.eye(4)
    p, s = (scalars[name].value(m) for name in ("polarizance_purity", "spherical_purity"))
    np.testing.assert_allclose(np.sqrt(2 / 3 * p**2 + s**2), quantities.depolarization_index(m), rtol=1e-12)
    for name, of in (("spherical_purity", mueller.retarder(0.3, 1.0)), ("polarizance_purity", mueller.polarizer(0.3))):
        assert float(scalars[name].value(7 * of)) == pytest.approx(1)


def test_a_file_that_is_no_quantity_is_refused() -> None:
    module = ModuleType("nothing", "A title.")
    with pytest.raises(ProcessError, match=r"nothing is no quantity: .*value"):
        scalar_files.read_scalar("nothing", module)
