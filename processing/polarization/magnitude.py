"""Intervals of the length of a vector with noise, for vectors of 1 to 18 components: every length has one.

Noise pushes lengths up, and an error bar that exists only where a length stands out is chosen by its outcome. Here the
interval is that of Feldman and Cousins (Phys. Rev. D 57, 3873, 1998) for the distribution of the observed length: it
covers as often as it claims at every true length, zero included, and passes from an upper limit to two sides by itself.
The table is made by `benchmarks/magnitude_table.py`. It knows the noise along the vector and how many directions noise
has. From 1.5 times the noise on, bounds are those of a modified signed root, which follows noise in all directions.

Units: u^2 = tr C^2 / tr C, C being the covariance of the vector. In them the noise has `components` = (tr C)^2 / tr C^2
components, and at most sqrt(components) is the variance along the vector; for n components alike these are n and 1.
"""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.threads import for_ranges
from processing.polarization.length_kernels import DEVIATES, LEAST, lengths

LEVELS = (0.68268949, 0.95)
#: Half the 95 % interval of a normal distribution, in standard deviations.
NORMAL_95 = DEVIATES[1]
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


def interval(
    length: Array,
    along: Array,
    total: Array,
    square: Array,
    *,
    plane: tuple[Array | float, Array | float, Array | float] = (0.0, 0.0, 0.0),
    far: Array | float = 1.0,
) -> Interval:
    """Interval of the true length of vectors.

    Parameters
    ----------
    length : (...), observed.
    along : (...), variance along the vector.
    total, square : (...), tr C and tr C^2.
    plane : (...) each, `mixed`, `across` and `further` of `vector_noise.VectorNoise`; 0: not known.
    far : (...), variances for the 95 % interval over those for the 68 % interval.

    Examples
    --------
    >>> import numpy as np
    >>> seen, one = np.array([0.5, 8.0]), np.ones(2)
    >>> found = interval(seen, one, 3 * one, 3 * one)
    >>> [bool(low == 0) for low in found.low]
    [True, False]
    """
    flat, out = np.empty((8, length.size)), np.empty((4, length.size))
    for row, part in zip(flat.reshape(8, *length.shape), (length, along, total, square, *plane, far), strict=True):
        row[...] = part
    table, nodes = _table()[0], (COMPONENTS, ALONG, OBSERVED)
    for_ranges(length.size, lambda start, stop: lengths(table, nodes, flat, out, start, stop))
    return Interval(*out.reshape(4, *length.shape))


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


#: Length over error up to which the 68 and 95 % interval of a direction holds every direction. With 1 and 1.96 they
#: would cover 54 to 68 and 90 to 95 % (shortest vectors first), as the opposite direction is left out of them.
ANY_DIRECTION = (1.4, 2.4)


class Directions(NamedTuple):
    """Of vectors in a plane, in radians: half the 68 % interval, and the ends of the 95 % interval, from the vector.

    The 68 % interval is the smallest one about the vector that contains Fieller's.
    """

    half: Array
    low: Array
    high: Array


def directions(vector: Array, covariance: Array, both_ends: bool = False, of_68: Array | float = 1.0) -> Directions:
    """Intervals of the directions of vectors (2, ...) with this covariance (3, ...), 00, 11, 01, after Fieller.

    A direction is rejected where the vector's component across it is beyond its error, which is exact at any length and
    for any covariance.

    Parameters
    ----------
    both_ends : a direction and its opposite count as one.
    of_68 : (...), errors for the 68 % interval over those for the 95 % interval, which `covariance` has.

    Examples
    --------
    >>> import numpy as np
    >>> found = directions(np.array([[1.0, 10.0], [0.0, 0.0]]), np.array([[1.0, 1.0], [1.0, 1.0], [0.0, 0.0]]))
    >>> (found.high * 180 / np.pi).round(1).tolist()
    [180.0, 11.3]
    """
    x, y = np.asarray(vector, dtype=float)
    xx, yy, xy = np.asarray(covariance, dtype=float)
    determinant = np.maximum(xx * yy - xy**2, 0.0)
    length = x**2 + y**2
    across = np.maximum(x**2 * yy + y**2 * xx - 2 * x * y * xy, 0.0)
    # With the axis of the vector as the first one; both angles are half of what these are the tangents of.
    turned = 2 * (x * y * (yy - xx) + (x**2 - y**2) * xy) / length
    sides = []
    for deviate, limit in ((of_68, ANY_DIRECTION[0] * of_68), (NORMAL_95, ANY_DIRECTION[1])):
        square = np.square(deviate)
        p, q = length - square * (xx + yy - 2 * across / length), -square * turned
        trace, root = length - square * (xx + yy), 2 * deviate * np.sqrt(np.maximum(across - square * determinant, 0.0))
        everything = across <= (deviate if both_ends else limit) ** 2 * determinant
        sides.append((p, q, trace, root, everything))
    whole = np.pi / 2 if both_ends else np.pi
    (p, q, trace, root, everything), far = sides
    both = _angle(p * root + np.abs(q) * trace, p * trace - np.abs(q) * root)
    half = np.where(everything, whole, np.where(both < 0, both + 2 * np.pi, both) / 2)
    p, q, trace, root, everything = far
    off, wide = _angle(q, p) / 2, _angle(root, trace) / 2
    return Directions(half, *(np.where(everything, side * whole, off + side * wide) for side in (-1, 1)))


def _angle(y: Array, x: Array) -> Array:
    """The same as arctan2, in half the time where all are within 90 degrees."""
    return np.asarray(np.arctan(y / x) if (x > 0).all() else np.arctan2(y, x))


#: Grid of `positive`: true and observed values, in standard errors.
_TRUE, _SEEN = np.arange(0, 6, 0.05), np.arange(-6, 12, 0.02)


def positive(observed: Array, level: int, end: int) -> Array:
    """Lower (0) or upper (1) bound at 68 (0) or 95 % of a number that is not negative, observed with an error of 1.

    Examples
    --------
    >>> import numpy as np
    >>> [positive(np.array([-1.0, 5.0]), 0, end).round(1).tolist() for end in (0, 1)]
    [[0.0, 4.0], [0.3, 6.0]]
    """
    bound = np.interp(observed, _of_positive()[level][1 - end], _TRUE, left=None if end else 0.0)
    return np.where(observed > _TRUE[-1] - 2, observed + (2 * end - 1) * DEVIATES[level], bound)


@cache
def _of_positive() -> list[NDArray[np.float64]]:
    """Least and largest observation (2, true values) that each true value accepts, at both levels."""
    steps = _SEEN[1] - _SEEN[0]
    off, best = _SEEN - _TRUE[:, None], np.minimum(_SEEN, 0.0)
    order = np.argsort(off**2 - best**2, axis=1, kind="stable")
    taken = np.cumsum(np.take_along_axis(np.exp(-(off**2) / 2), order, axis=1), axis=1) * steps / np.sqrt(2 * np.pi)
    found = []
    for level in LEVELS:
        ends = []
        for numbers, sums in zip(order, taken, strict=True):
            kept = _SEEN[numbers[: np.searchsorted(sums, level) + 1]]
            ends.append((kept.min(), kept.max()))
        found.append(np.maximum.accumulate(np.array(ends).T, axis=1))
    return found


def sum_of_singular_values(observed: Array, unit: Array, own: Array, components: float) -> Interval:
    """Interval of the sum of the singular values of 3 x 3 matrices, as of a depolarizer.

    Of noise that is alike in all directions the table has it. Of noise in one direction the sum is a length: in a plane
    with `own`, and with three times the noise of all elements across, which adds as much to it by second order.

    Parameters
    ----------
    observed : (...), sum of those of the noisy matrix.
    unit : (...), root mean square error of the elements.
    own : (...), error of the sum to first order.
    components : directions that the noise has, see `sorted_eigenvalues.block_components`.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        seen, spread = observed / unit, own / unit
        known = np.isfinite(seen) & (seen >= 0)
        low, high, low_95, high_95, end = (np.interp(seen, SUMS, line) for line in _table()[1])
        value = np.where(low > 0, (low + high) / 2, np.minimum(high**2 / end, high) / 2)
        by = spread / np.sqrt(3)
        below = np.where(low_95 > 0, np.maximum(value - by * (value - low_95), 0), 0)
        near = [value, by * np.maximum(high - value, LEAST), below, value + by * (high_95 - value)]
        # Second order: noise shared by two singular values adds its square over their sum.
        far = seen - 4.5 / np.maximum(seen, 1.0)
        beyond = [far, spread, far - NORMAL_95 * spread, far + NORMAL_95 * spread]
        scale, is_near = np.where(known, unit, np.nan), seen < SUMS[-1]
        alike = [np.where(is_near, a, b) * scale for a, b in zip(near, beyond, strict=True)]
        along, across = np.square(own), 9 * np.square(unit)
        one = interval(observed, along, along + across, along**2 + across**2 / np.minimum(components, 3))
        share = (8 / components - 1) / 7
        mixed = Interval(*((1 - share) * a + share * b for a, b in zip(alike, one, strict=True)))
        return mixed._replace(low=np.where(below > 0, mixed.low, alike[2]))
