"""One matrix for all pixels: what an inversion holds, and the product with planes tile by tile."""

import numpy as np
import pytest

from processing.errors import NotDetermined
from processing.reduction.solvers.inversion import TILE, Inversion, mueller_planes, multiply_tiles


def matrix(rows: int, columns: int = 16, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((rows, columns))


def test_an_inversion_holds_the_inverse_and_what_it_cannot_explain():
    w = matrix(20)
    inverse = Inversion.of(w)
    np.testing.assert_allclose(inverse.pinv @ w, np.eye(16), atol=1e-12)
    # The residual's rows see nothing that W explains, are orthonormal, and are all there are.
    assert inverse.null.shape == (4, 20)
    np.testing.assert_allclose(inverse.null @ w, 0, atol=1e-12)
    np.testing.assert_allclose(inverse.null @ inverse.null.T, np.eye(4), atol=1e-12)
    assert (inverse.rank, inverse.degrees_of_freedom) == (16, 4)
    assert inverse.condition_number == pytest.approx(np.linalg.cond(w))
    np.testing.assert_array_equal(inverse.basis, np.eye(16))
    assert inverse.w is w


def test_a_partial_polarimeter_is_inverted_among_what_it_determines():
    basis = np.eye(16)[:, :9]
    w = matrix(12, 9) @ basis.T
    inverse = Inversion.of(w, basis=basis)
    assert (inverse.rank, inverse.degrees_of_freedom, inverse.null.shape) == (9, 3, (3, 12))
    np.testing.assert_allclose(inverse.pinv @ w, basis @ basis.T, atol=1e-12)
    assert inverse.condition_number == pytest.approx(np.linalg.cond(w @ basis))
    np.testing.assert_array_equal(inverse.basis, basis)


def test_what_the_states_do_not_see_is_named():
    w = matrix(20)
    w[:, [6, 12]] = 0.0
    with pytest.raises(NotDetermined) as refusal:
        Inversion.of(w, "a.h5: ")
    assert str(refusal.value).startswith(
        "a.h5: the measurement matrix W has rank 14, and 16 are needed: 20 intensities a pixel do not determine "
        "m12, m30 (each alone"
    )
    with pytest.raises(NotDetermined, match=r"^the measurement matrix W has rank 3, and 4 are needed"):
        Inversion.of(matrix(6, 3) @ np.eye(3, 16), basis=np.eye(16)[:, :4])


@pytest.mark.parametrize("pixels", [1, TILE, 2 * TILE + 37])
@pytest.mark.parametrize("offset", [0.0, 12.5, "each"])
def test_planes_are_multiplied_tile_by_tile_after_their_offset(pixels, offset):
    random = np.random.default_rng(1)
    frames = random.integers(0, 4096, (5, pixels)).astype(np.uint16)
    each = random.uniform(0, 30, pixels).astype(np.float32)
    dark = each if offset == "each" else np.float32(offset)
    m = matrix(3, 5).astype(np.float32)
    out = np.full((3, pixels), np.nan, dtype=np.float32)
    multiply_tiles(m, frames, out, dark if offset == "each" else offset)
    np.testing.assert_allclose(out, m @ (frames - dark), rtol=2e-5, atol=0.05)


def test_frames_may_be_of_any_type_and_without_black():
    frames = np.arange(15.0).reshape(5, 3)
    out = np.empty((3, 3), dtype=np.float32)
    m = matrix(3, 5).astype(np.float32)
    multiply_tiles(m, frames, out)
    np.testing.assert_allclose(out, m @ frames, rtol=1e-5, atol=1e-4)


def test_mueller_elements_of_frames():
    w, m = matrix(20), matrix(16, 50, seed=2)
    inverse = Inversion.of(w)
    frames = 1000 * w @ m
    planes = mueller_planes(inverse, frames)
    assert (planes.shape, planes.dtype) == ((16, 50), np.float32)
    np.testing.assert_allclose(planes, 1000 * m, atol=0.05)
    # The black goes off every frame, and memory that is given is used.
    out = np.empty((16, 50), dtype=np.float32)
    assert mueller_planes(inverse, frames + 64.0, out, 64.0) is out
    np.testing.assert_allclose(out, 1000 * m, atol=0.05)
