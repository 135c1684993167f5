"""Noise of vectors that a Mueller matrix gives, from the covariance of its 16 elements."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array, RealArray
from processing.computing.threads import for_ranges
from processing.polarization import vector_kernels as kernels


class VectorNoise(NamedTuple):
    """Of the covariance C of vectors v (...).

    Attributes
    ----------
    along : variance along v.
    total, square : tr C and tr C^2.
    mixed, across : noise along v turns it: the square of its covariance with the direction to which it does, and the
        variance along that.
    further : likewise the square of the covariance of that direction with all others but v.
    packed : (6, ...), of the first three components: 00, 11, 22, 01, 12, 02; NaN where there are fewer.
    """

    along: Array
    total: Array
    square: Array
    mixed: Array
    across: Array
    further: Array
    packed: Array


def of_elements(covariance: NDArray[np.floating], m: Array, elements: Sequence[int]) -> VectorNoise:
    """Of elements over m00, from the covariance (..., 16, 16) of matrices (..., 4, 4)."""
    flat = np.ascontiguousarray(m.reshape(-1, 16).T, dtype=np.float32)
    numbers = np.asarray(elements)
    return _each(covariance, m.shape[:-2], lambda *rest: kernels.elements(flat, numbers, *rest))


def of_slopes(covariance: NDArray[np.floating], vector: RealArray, slopes: RealArray) -> VectorNoise:
    """Of vectors (n, ...) with these gradients (n, ..., 16), likewise."""
    values = np.ascontiguousarray(vector.reshape(len(vector), -1), dtype=np.float32)
    by = np.ascontiguousarray(np.swapaxes(slopes.reshape(len(vector), -1, 16), 1, 2), dtype=np.float32)
    return _each(covariance, vector.shape[1:], lambda *rest: kernels.slopes(values, by, *rest))


def _each(covariance: NDArray[np.floating], shape: tuple[int, ...], loop: Callable[..., object]) -> VectorNoise:
    each = np.ascontiguousarray(np.moveaxis(covariance.reshape(-1, 16, 16), 0, -1), dtype=np.float32)
    out = np.empty((12, each.shape[-1]), np.float32)
    for_ranges(each.shape[-1], lambda start, stop: loop(each, out, start, stop))
    found = out.reshape(-1, *shape).astype(float)
    along, total, square, mixed, across, further = found[:6]
    return VectorNoise(along, total, square, mixed, across, further, found[6:])
