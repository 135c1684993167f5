"""A correction that explains as much and changes M less, where the data do not tell how M changes.

Gains and extinctions of the channels of a polarization camera are known in one combination alone; stray light,
extinctions and an offset are alike in the counts and not in M. The least error is to be expected of the mean of the
posterior, but the chance that it makes M worse than no correction is smaller for what goes less far. The values are
moved along what is open, each direction the more the less is known of it, until that chance is small enough.
"""

from __future__ import annotations

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.guard import slopes_of
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import AS_GOOD_AS, CHANCE_WORSE
from processing.diagnosis.search.solution import Solution

#: [1] Weights of the change of M that are tried.
WEIGHTS = 10.0 ** np.arange(2, 16, 0.25)


def cautious(problem: InstrumentProblem, found: Posterior, solved: Solution) -> Array | None:
    """Values (K,) that are as good as the mean of a posterior and hardly make M worse, here and in later captures.

    Where that is too much, hardly here. None where these are those of the mean, or there are no such values.
    """
    slopes = slopes_of(problem, found, solved)
    if slopes is None:
        return None
    parts = (np.ones(slopes.index.size, dtype=bool), slopes.lasting)

    def too_likely(values: Array) -> tuple[bool, ...]:
        given = np.where(slopes.applied, values[slopes.index], 0.0)
        return tuple(slopes.predicted_change(found, given, p).chance_worse > CHANCE_WORSE for p in parts)

    worse = too_likely(found.values)
    if not any(worse):
        return None
    index, own = slopes.index[slopes.applied], np.ix_(slopes.applied, slopes.applied)
    weights = sum(np.outer(part, part) for part, bad in zip(parts, worse, strict=True) if bad)
    covariance, asked = found.covariance[np.ix_(index, index)], (slopes.products * weights)[own]
    values, here = found.values.copy(), None
    for weight in WEIGHTS:
        less = less_far(found.values[index], covariance, asked, float(weight))
        if less is None:
            break
        values[index] = less
        now = too_likely(values)
        if not any(now):
            return values
        if worse[0] and not now[0] and here is None:
            here = values.copy()
    return here


def less_far(mean: Array, covariance: Array, products: Array, weight: float) -> Array | None:
    """Values (K,) beside the mean of a posterior that change M less; None where they are not as good any more.

    `products` (K, K) of the slopes of M/m00, averaged.
    """
    values = np.linalg.solve(np.eye(mean.size) + weight * covariance @ products, mean)
    # The step is covariance @ products @ values, times the weight: its length in standard deviations.
    pull = products @ values
    if weight * np.sqrt(max(float(pull @ covariance @ pull), 0.0)) > AS_GOOD_AS:
        return None
    return np.asarray(values)
