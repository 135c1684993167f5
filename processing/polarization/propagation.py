"""Delta method: standard errors of derived quantities from the covariance of the 16 Mueller elements.

First order, so it holds where a quantity is smooth over the errors. It does not where the quantity sits at an edge:
a magnitude smaller than about three of its errors is biased upwards, and equal eigenvalues are pushed apart by noise.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from processing.arrays import RealArray

#: Step of the numerical derivative, relative to m00: rounding and truncation are then both about 1e-9.
STEP = 1e-6


class Derived(NamedTuple):
    """A quantity of each pixel with its gradient by the 16 Mueller elements, row-major."""

    value: RealArray
    """(..., pixels...)"""
    gradient: RealArray
    """(..., pixels..., 16)"""
    elements: tuple[int, ...] = ()
    """Of the length of a vector of elements over m00: their numbers, row-major."""
    parts: "Derived | None" = None
    """Of the length of another vector: its components (n, pixels...)."""


def numeric_gradient(
    function: Callable[[RealArray], RealArray], m: RealArray, period: RealArray | float = np.inf
) -> NDArray[np.float64]:
    """Gradient (..., Q, 16) of a function from Mueller matrices (..., 4, 4) to (..., Q), by central differences.

    `period` (Q,) is the period of angles, so that a step across their branch cut counts as the small step it is.
    """
    m = np.asarray(m, dtype=float)
    step = STEP * m[..., 0, 0]
    columns = []
    for k in range(16):
        shift = np.zeros(m.shape)
        shift[..., k // 4, k % 4] = step
        change = np.asarray(function(m + shift)) - np.asarray(function(m - shift))
        with np.errstate(invalid="ignore"):
            wrapped = np.where(np.isfinite(period), change - period * np.round(change / period), change)
        columns.append(wrapped / (2 * step[..., None]))
    return np.stack(columns, axis=-1)
