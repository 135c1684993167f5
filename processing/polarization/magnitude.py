"""Intervals of the length of a vector with noise, for vectors of 1 to 18 components: every length has one.

Noise pushes lengths up, and an error bar that exists only where a length stands out is chosen by its outcome. Here the
interval is that of Feldman and Cousins (Phys. Rev. D 57, 3873, 1998) for the distribution of the observed length: it
covers as often as it claims at every true length, zero included, and passes from an upper limit to two sides by itself.
The table is made by `benchmarks/magnitude_table.py`.

Units: u^2 = tr C^2 / tr C, C being the covariance of the vector. In them the noise has `components` = (tr C)^2 / tr C^2
components, and at most sqrt(components) is the variance along the vector; for n components alike these are n and 1.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.compiling import njit

LEVELS = (0.68268949, 0.95)
#: Error at least, in units of the noise: an observed length far below what noise alone makes allows hardly any length.
LEAST = 0.55
#: Half the 95 % interval of a normal distribution, in standard deviations.
NORMAL_95 = 1.959964
#: Nodes of the table; `ALONG` is over sqrt(components).
COMPONENTS = np.array([1, 1.25, 1.5, 1.75, 2, 2.5, 3, 3.5, 4, 5, 6, 7.5, 9, 11, 13, 15, 18.0])
ALONG = np.array([0.1, 0.2, 0.3, 0.45, 0.6, 0.72, 0.85, 1.0])
OBSERVED = np.linspace(0, 10, 101)
SUMS = np.linspace(0, 25, 101)
TABLE = Path(__file__).with_name("magnitude_table.npz")


class Interval(NamedTuple):
    """Of each pixel, in the unit of the quantity.

    Attributes
    ----------
    value, error : value +- error is the 68 % interval; a length below zero within it does not exist.
    low, high : the 95 % interval.
    """

    value: Array
    error: Array
    low: Array
    high: Array


def interval(length: Array, along: Array, total: Array, square: Array) -> Interval:
    """Interval of the true length of vectors.

    Parameters
    ----------
    length : (...), observed.
    along : (...), variance along the vector.
    total, square : (...), tr C and tr C^2.

    Examples
    --------
    >>> import numpy as np
    >>> seen, one = np.array([0.5, 8.0]), np.ones(2)
    >>> found = interval(seen, one, 3 * one, 3 * one)
    >>> [bool(low == 0) for low in found.low]
    [True, False]
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = np.sqrt(square / total)
        components, share = total**2 / square, along / unit**2
        seen = length / unit
        # A length over a negative m00 is none.
        known = np.isfinite(seen) & (seen >= 0) & np.isfinite(components) & np.isfinite(share)
        at = np.stack(
            [
                np.interp(np.where(known, components, 1.0), COMPONENTS, np.arange(len(COMPONENTS))),
                np.interp(np.where(known, share / np.sqrt(components), 1.0), ALONG, np.arange(len(ALONG))),
                np.where(known, seen, 0.0) / (OBSERVED[1] - OBSERVED[0]),
            ]
        )
        near = _near(_table()[0], at)
        # Far from zero: noise across adds its square, and its scatter.
        far = np.sqrt(np.maximum(seen**2 - components + share, 1.0))
        spread = np.sqrt(share + np.maximum(components - share**2, 0) / (2 * far**2))
        beyond = [far, spread, far - NORMAL_95 * spread, far + NORMAL_95 * spread]
        out = [
            np.where(known, np.where(seen < OBSERVED[-1], a, b) * unit, np.nan)
            for a, b in zip(near, beyond, strict=True)
        ]
    return Interval(*out)


@cache
def _table() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bounds at 68 and 95 %, and what an upper limit is where it ends (5, ...): of lengths and of sums.

    The lower ones go on below zero.
    """
    with np.load(TABLE) as stored:
        return _with_ends(np.moveaxis(stored["lengths"], 2, 0)), _with_ends(stored["sums"])


def _with_ends(bounds: NDArray[np.float32]) -> NDArray[np.float64]:
    low, high = bounds[0], bounds[1]
    end = np.take_along_axis(high, np.argmax(low > 0, axis=-1)[..., None], axis=-1)
    return np.concatenate([bounds, np.broadcast_to(end, low.shape)[None]]).astype(float)


def _near(table: NDArray[np.float64], at: Array) -> list[Array]:
    """Value, error, bounds at 95 %, interpolated at nodes (coordinates, ...); a line is a table of one by one."""
    cube = table if table.ndim == 4 else table[:, None, None]
    places = np.ascontiguousarray(at.reshape(len(at), -1))
    if len(places) == 1:
        places = np.concatenate([np.zeros((2, places.shape[1])), places])
    found = np.empty((5, places.shape[1]))
    interpolate(np.ascontiguousarray(np.moveaxis(cube, 0, -1)), places, found)
    low, high, low_95, high_95, end = found.reshape(5, *at.shape[1:])
    # Of an upper limit alone the value goes to zero with what is observed.
    value = np.where(low > 0, (low + high) / 2, np.minimum(high**2 / end, high) / 2)
    return [value, np.maximum(high - value, LEAST), np.maximum(low_95, 0), high_95]


@njit(cache=True, nogil=True)
def interpolate(table, places, out):  # type: ignore[no-untyped-def]
    """Linear interpolation of all planes of a table (n, m, k, planes) at `places` (3, pixels); beyond it the last."""
    last = (table.shape[0] - 1, table.shape[1] - 1, table.shape[2] - 1)
    for p in range(places.shape[1]):
        x, y, z = min(places[0, p], last[0]), min(places[1, p], last[1]), min(places[2, p], last[2])
        i, j, k = int(x), int(y), int(z)
        x, y, z = x - i, y - j, z - k
        i1, j1, k1 = min(i + 1, last[0]), min(j + 1, last[1]), min(k + 1, last[2])
        for n in range(table.shape[3]):
            a = (1 - z) * table[i, j, k, n] + z * table[i, j, k1, n]
            b = (1 - z) * table[i, j1, k, n] + z * table[i, j1, k1, n]
            c = (1 - z) * table[i1, j, k, n] + z * table[i1, j, k1, n]
            d = (1 - z) * table[i1, j1, k, n] + z * table[i1, j1, k1, n]
            out[n, p] = (1 - x) * ((1 - y) * a + y * b) + x * ((1 - y) * c + y * d)


#: Error over length from which on the 68 and 95 % interval of a direction holds every direction. At 1 and 1/1.96 they
#: would cover 54 to 68 and 90 to 95 % (shortest vectors first), as the opposite direction is left out of them.
ANY_DIRECTION = (1 / 1.4, 1 / 2.4)


def directions(ratio: Array, both_ends: bool = False) -> tuple[Array, Array]:
    """Half widths (...), radians, of the 68 and 95 % interval of the direction of a vector in a plane, after Fieller.

    A direction is rejected where the vector's component across it is beyond its error, which is exact at any length.

    Parameters
    ----------
    ratio : (...), error across the vector over its length.
    both_ends : a direction and its opposite count as one.
    """
    out = []
    for deviate, limit in zip((1.0, NORMAL_95), ANY_DIRECTION, strict=True):
        half = np.arcsin(np.minimum(deviate * ratio, 1.0))
        out.append(half if both_ends else np.where(ratio > limit, np.pi, half))
    return out[0], out[1]


def sum_of_singular_values(observed: Array, unit: Array) -> Interval:
    """Interval of the sum of the singular values of 3 x 3 matrices, taken as alike, as of a depolarizer.

    Parameters
    ----------
    observed : (...), sum of those of the noisy matrix.
    unit : (...), standard error of one element.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = observed / unit
        known = np.isfinite(seen) & (seen >= 0)
        at = [np.where(known, seen, 0.0) / (SUMS[1] - SUMS[0])]
        near = _near(_table()[1], np.stack(at))
        # Second order: noise shared by two singular values adds its square over their sum.
        far, spread = seen - 4.5 / np.maximum(seen, 1.0), np.sqrt(3.0)
        beyond = [far, np.full_like(far, spread), far - NORMAL_95 * spread, far + NORMAL_95 * spread]
        pairs = zip(near, beyond, strict=True)
        return Interval(*(np.where(known, np.where(seen < SUMS[-1], a, b) * unit, np.nan) for a, b in pairs))
