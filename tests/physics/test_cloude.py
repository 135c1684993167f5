"""Cloude decomposition against a plain eigenvalue solver, analytic cases and close eigenvalues."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from random_matrices import random_mueller

from processing.computing.threads import for_ranges, thread_count
from processing.polarization import mueller
from processing.polarization.cloude import cloude, coherency_eigenvalues, xi0_and_dominant

Array = NDArray[np.float64]


def solve(m: Array) -> tuple[Array, Array]:
    """Eigenvalues (descending, sum 1) and their Mueller-Jones matrices, by numpy's solver."""
    h = mueller.coherency(m)
    w, v = np.linalg.eigh(h / np.trace(h, axis1=-2, axis2=-1)[..., None, None])
    jones = np.sqrt(2) * np.moveaxis(v, -1, -2).reshape(*m.shape[:-2], 4, 2, 2)
    return w[..., ::-1], mueller.from_jones(jones)[..., ::-1, :, :]


def with_eigenvalues(xi: Array, count: int, seed: int) -> tuple[Array, Array]:
    """Matrices of given eigenvalues in random directions, and the Mueller-Jones matrix of the first."""
    rng = np.random.default_rng(seed)
    q = np.linalg.qr(rng.normal(size=(count, 4, 4)) + 1j * rng.normal(size=(count, 4, 4)))[0]
    m = mueller.coherency_to_mueller((q * xi) @ np.conj(np.swapaxes(q, -1, -2)))
    return m, mueller.from_jones(np.sqrt(2) * q[..., 0].reshape(count, 2, 2))


def test_agrees_with_the_eigenvalue_solver() -> None:
    m = random_mueller(3000, seed=1, spread=3.0)
    xi, parts = solve(m)
    np.testing.assert_allclose(coherency_eigenvalues(m), xi, atol=1e-13)
    xi0, m0 = xi0_and_dominant(m)
    np.testing.assert_allclose(xi0, xi[:, 0], atol=1e-13)
    np.testing.assert_allclose(m0, parts[:, 0], atol=1e-10)


def test_unphysical_matrices_keep_their_negative_eigenvalues() -> None:
    m = random_mueller(500, seed=2, spread=3.0) + np.random.default_rng(3).normal(scale=0.5, size=(500, 4, 4))
    m = m[m[:, 0, 0] > 0.3]
    xi = solve(m)[0]
    assert xi.min() < -0.01
    np.testing.assert_allclose(coherency_eigenvalues(m), xi, atol=1e-12)
    np.testing.assert_allclose(xi0_and_dominant(m)[0], xi[:, 0], atol=1e-12)


@pytest.mark.parametrize("gap", [1e-2, 1e-3, 1e-4, 1e-6, 1e-8])
@pytest.mark.parametrize("small", [(0.25, 0.15), (0.3, 0.1)])
def test_close_eigenvalues_lose_only_the_digits_that_are_lost(gap: float, small: tuple[float, float]) -> None:
    # The direction of an eigenvector is known to rounding / gap, whatever the method.
    m, truth = with_eigenvalues(np.array([0.3 + gap, 0.3, *small]), 400, seed=4)
    xi0, m0 = xi0_and_dominant(m)
    np.testing.assert_allclose(xi0, (0.3 + gap) / (0.6 + gap + sum(small)), atol=1e-14)
    np.testing.assert_allclose(m0, truth, atol=2e-14 / gap)


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e-6])
def test_strong_depolarizers_keep_their_relative_precision(scale: float) -> None:
    excess = scale * np.array([0.75, -0.2, -0.25, -0.3])
    m, truth = with_eigenvalues(0.25 + excess, 200, seed=5)
    xi0, m0 = xi0_and_dominant(m)
    np.testing.assert_allclose(xi0 - 0.25, excess[0], rtol=1e-9)
    np.testing.assert_allclose(m0, truth, atol=1e-13 / scale)


def test_triply_degenerate_matrix() -> None:
    m0 = mueller.polarizer(0.3) * 2
    for xi0 in (0.26, 0.5, 0.99, 1.0):
        m = 7.0 * 4 / 3 * ((xi0 - 0.25) * m0 + (1 - xi0) * mueller.IDEAL_DEPOLARIZER)
        np.testing.assert_allclose(coherency_eigenvalues(m), [xi0, *3 * [(1 - xi0) / 3]], atol=1e-14)
        estimate, dominant = xi0_and_dominant(m)
        np.testing.assert_allclose(estimate, xi0, atol=1e-14)
        np.testing.assert_allclose(dominant, m0, atol=1e-12)


def test_below_a_quarter_the_model_process_has_the_smallest_eigenvalue() -> None:
    m0 = mueller.retarder(0.3, 1.0) @ mueller.diattenuator(0.1, 1.0, 0.2) / 0.6
    xi0 = 0.15
    m = 4 / 3 * ((xi0 - 0.25) * m0 + (1 - xi0) * mueller.IDEAL_DEPOLARIZER)
    np.testing.assert_allclose(coherency_eigenvalues(m), [*3 * [(1 - xi0) / 3], xi0], atol=1e-14)


def test_the_four_parts_add_up() -> None:
    m = random_mueller(300, seed=6, spread=3.0)
    xi, parts = cloude(m)
    np.testing.assert_allclose(np.einsum("nk,nkij->nij", xi, parts) * m[:, :1, :1], m, rtol=0, atol=1e-12 * m.max())
    np.testing.assert_allclose(parts, solve(m)[1], atol=1e-9)
    np.testing.assert_allclose(parts.mean(axis=1), np.broadcast_to(mueller.IDEAL_DEPOLARIZER, m.shape), atol=1e-12)


def test_what_has_no_answer_is_nan() -> None:
    dark, ideal, broken = np.zeros((4, 4)), 2 * mueller.IDEAL_DEPOLARIZER, np.eye(4)
    broken[2, 1] = np.nan
    xi0, m0 = xi0_and_dominant(np.stack([dark, ideal, broken, -np.eye(4)]))
    np.testing.assert_array_equal(xi0, [np.nan, 0.25, np.nan, np.nan])
    assert np.isnan(m0).all()
    xi = coherency_eigenvalues(np.stack([dark, ideal, broken, -np.eye(4)]))
    np.testing.assert_array_equal(np.isnan(xi).all(axis=1), [True, False, True, True])
    np.testing.assert_array_equal(xi[1], 4 * [0.25])


def test_layout_and_type_do_not_matter() -> None:
    m = random_mueller(7 * 900, seed=7, spread=3.0).reshape(7, 900, 4, 4)
    xi0, m0 = xi0_and_dominant(m)
    planar = np.ascontiguousarray(np.moveaxis(m, (-2, -1), (0, 1)))
    for view in (np.moveaxis(planar, (0, 1), (-2, -1)), np.swapaxes(np.swapaxes(m, 0, 1).copy(), 0, 1)):
        xi0_of_view, m0_again = xi0_and_dominant(view)
        np.testing.assert_array_equal(xi0_of_view, xi0)
        np.testing.assert_array_equal(m0_again, m0)
    single, m0_single = xi0_and_dominant(m.astype(np.float32))
    assert single.dtype == m0_single.dtype == np.float32
    np.testing.assert_allclose(single, xi0, atol=1e-6)
    first = xi0_and_dominant(m)
    second = xi0_and_dominant(2 * np.swapaxes(m, -1, -2), out=first)
    assert np.shares_memory(second[1], first[1])
    np.testing.assert_array_equal(second[0], xi0_and_dominant(2 * np.swapaxes(m, -1, -2))[0])
    with pytest.raises(ValueError, match="an earlier call"):
        xi0_and_dominant(m[:3], out=first)
    with pytest.raises(ValueError, match=r"shape \(\.\.\., 4, 4\); got \(16, 7\)"):
        xi0_and_dominant(np.zeros((16, 7)))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.05, 6))
def test_physical_matrices_have_no_negative_eigenvalue(seed: int, spread: float) -> None:
    xi = coherency_eigenvalues(random_mueller(20, seed, spread))
    np.testing.assert_allclose(xi.sum(axis=-1), 1, atol=1e-13)
    assert (np.diff(xi) <= 0).all()
    assert xi.min() > -1e-13


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.floats(-4, 4), st.floats(-4, 4))
def test_turning_the_frames_turns_the_dominant_process_and_keeps_xi0(seed: int, before: float, after: float) -> None:
    m = random_mueller(5, seed, spread=3.0)
    turn_out, turn_in = mueller.rotation(after), mueller.rotation(before)
    xi0, m0 = xi0_and_dominant(m)
    turned_xi0, turned = xi0_and_dominant(turn_out @ m @ turn_in)
    np.testing.assert_allclose(turned_xi0, xi0, atol=1e-12)
    gap = -np.diff(coherency_eigenvalues(m))[:, :1, None]
    assert (np.abs(turned - turn_out @ m0 @ turn_in) < 1e-11 / gap).all()


def test_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UMOV_THREADS", "3")
    assert thread_count() == 3
    visits = np.zeros(20_001, dtype=int)

    def loop(start: int, stop: int) -> None:
        visits[start:stop] += 1

    for_ranges(visits.size, loop)
    assert (visits == 1).all()

    def fails(start: int, stop: int) -> None:
        if start:
            raise ArithmeticError("in a thread")

    with pytest.raises(ArithmeticError, match="in a thread"):
        for_ranges(visits.size, fails)
    monkeypatch.setenv("UMOV_THREADS", "none")
    with pytest.raises(ValueError, match="UMOV_THREADS='none'"):
        thread_count()
