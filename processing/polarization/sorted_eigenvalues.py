"""Intervals of three eigenvalues of a noisy Hermitian matrix, which noise pushes apart: each covers at every gap.

The mean of the three is normal, their gaps are not. A bound is the observed eigenvalue plus a shift that depends on
both gaps; the shifts are those with which a bound holds as often as it claims, whatever the true gaps are. The table
is made by `benchmarks/eigenvalue_table.py`.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.polarization.length_kernels import interpolate
from processing.polarization.magnitude import NORMAL_95

#: Nodes of the table along both gaps, in units of the noise of an element.
GAPS = np.array([0, 1, 2, 3, 4, 5, 6.5, 8.5, 11, 14.0])
#: Nodes of the table of singular values along the largest less the middle one, and the middle one less and plus the
#: smallest, in units of the noise of an element.
SUMS = np.array([0, 1, 2, 3.5, 5.5, 9.0])
#: Nodes along the number of directions that the noise has: (tr C)^2 / tr C^2, C being the covariance of the block.
COMPONENTS = (1.3, 1.6, 2.2, 3.5, 5.5, 8.0)
#: Errors to first order, of the eigenvectors that are seen, are at least this part of what they are with equal noise.
LEAST_OWN = 0.3
#: Variance of the mean of the three in that unit squared: of an isotropic 4 x 4 matrix of fixed trace.
OF_MEAN = 1 / 12
TABLE = Path(__file__).with_name("eigenvalue_table.npz")
#: A half width squared is at least this part of what it is with the noise of the mean.
_LEAST = 0.05


class Sorted(NamedTuple):
    """Of three eigenvalues (3, ...), descending, in units of the noise: shifts from the observed deviations.

    Attributes
    ----------
    middle, half : of the 68 % interval; the three middles add up to zero.
    below, above : from there to the ends of the 95 % interval.
    own : errors to first order, over those with noise that is alike in all directions; all widths are in proportion.
    """

    middle: Array
    half: Array
    below: Array
    above: Array
    own: Array | float = 1.0

    def with_mean(self, u: Array) -> "Sorted":
        """Intervals where the mean of the three has this standard uncertainty (...) instead."""

        def wide(size: Array, deviate: float) -> Array:
            alone = np.maximum(size**2 - np.square(deviate * self.own) * OF_MEAN, _LEAST * size**2)
            return np.asarray(np.sqrt(alone + np.square(deviate * u)))

        below, above = (wide(size, NORMAL_95) for size in (self.below, self.above))
        return Sorted(self.middle, wide(self.half, 1.0), below, above, self.own)


def block_components(covariance: NDArray[np.float64]) -> float:
    """Directions that the noise of a block of three eigenvalues has, on average over blocks.

    Parameters
    ----------
    covariance : (16, 16), of the elements of an ideal depolarizer, in any unit.

    Examples
    --------
    >>> import numpy as np
    >>> round(block_components(np.eye(16)), 6)
    8.0
    """
    elements = covariance[1:, 1:]
    whole = np.sum(elements**2) / np.trace(elements) ** 2
    # Exact for one direction, which is all that a block sees of it, and for 15 alike.
    return float(1 / (1 / 8 + 15 / 16 * (whole - 1 / 15)))


def of_gaps(first: Array, second: Array, own: Array, components: float) -> Sorted:
    """Intervals for the observed gaps (...) of the largest and of the smallest eigenvalue to the middle one.

    Parameters
    ----------
    own : (3, ...), errors of the deviations to first order, over those with noise that is alike in all directions.
    components : see `block_components`.

    Examples
    --------
    >>> import numpy as np
    >>> found = of_gaps(np.array([1.0, 20.0]), np.array([1.0, 20.0]), np.ones((3, 2)), 8.0)
    >>> found.half[0].round(1).tolist(), bool(found.middle[0, 0] < -1)
    ([0.9, 0.9], True)
    """
    one, other = (_shifts(*gaps, components) for gaps in ((first, second), (second, first)))
    own = np.maximum(own, LEAST_OWN)
    # The smallest is the largest of the matrix with the opposite sign, and the middle one stays the middle one.
    low, high = own * np.stack([one[0], one[4], -other[1]]), own * np.stack([one[1], -other[4], -other[0]])
    low_95, high_95 = own * np.stack([one[2], one[5], -other[3]]), own * np.stack([one[3], -other[5], -other[2]])
    # What the three add up to is known.
    middle = (low + high) / 2
    middle -= middle.mean(axis=0)
    return Sorted(middle, (high - low) / 2, middle - low_95, high_95 - middle, own)


def _shifts(first: Array, second: Array, components: float) -> NDArray[np.float64]:
    """Of the largest lower and upper bound at 68, then at 95 %; of the middle one the lower bounds: (6, ...)."""
    places = [np.interp(np.nan_to_num(gap), GAPS, np.arange(len(GAPS))).reshape(-1) for gap in (first, second)]
    node = np.full(first.size, np.interp(components, COMPONENTS, np.arange(len(COMPONENTS))))
    out = np.empty((6, first.size))
    interpolate(_table("shifts"), np.stack([node, *places]), out)
    return out.reshape(6, *first.shape)


def of_singular_values(values: Array, errors: Array, unit: Array, components: float) -> Sorted:
    """The same, in the unit of the values, of three singular values (3, ...): the smallest has the determinant's sign.

    Parameters
    ----------
    errors : (3, ...), to first order.
    unit : (...), noise of an element of their matrix.

    Examples
    --------
    >>> import numpy as np
    >>> found = of_singular_values(np.array([[0.5], [0.4], [-0.2]]), np.full((3, 1), 0.01), np.full(1, 0.01), 8.0)
    >>> (found.half / 0.01).round(1).ravel().tolist()
    [1.0, 1.0, 1.0]
    """
    first, less, plus = values[0] - values[1], values[1] - values[2], values[1] + values[2]
    gaps = ((first, less, plus), (first, plus, less))
    one, other = (_singular([gap / unit for gap in each], components) for each in gaps)
    own = np.maximum(errors, LEAST_OWN * unit)
    low, high = own * np.stack([one[0], one[4], one[8]]), own * np.stack([one[1], one[5], -other[8]])
    low_95, high_95 = own * np.stack([one[2], one[6], one[9]]), own * np.stack([one[3], one[7], -other[9]])
    middle = (low + high) / 2
    return Sorted(middle, (high - low) / 2, middle - low_95, high_95 - middle)


def _singular(gaps: Sequence[Array], components: float) -> NDArray[np.float64]:
    """Of the largest and the middle one lower and upper bounds at 68, then at 95 %, of the smallest the lower ones."""
    places = [np.interp(np.nan_to_num(gap), SUMS, np.arange(len(SUMS))).reshape(-1) for gap in gaps]
    node = np.interp(components, COMPONENTS, np.arange(len(COMPONENTS)))
    below = min(int(node), len(COMPONENTS) - 2)
    table = _table("singular")
    near = np.ascontiguousarray(table[below] + (node - below) * (table[below + 1] - table[below]))
    out = np.empty((10, places[0].size))
    interpolate(near, np.stack(places), out)
    return out.reshape(10, *gaps[0].shape)


@cache
def _table(name: str) -> NDArray[np.float64]:
    with np.load(TABLE) as stored:
        return np.ascontiguousarray(np.moveaxis(stored[name], 1, -1), dtype=float)
