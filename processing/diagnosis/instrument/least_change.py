"""A correction that explains as much and leaves M as it is, where the data do not tell how M changes.

Gains and extinctions of the channels of a polarization camera are known in one combination alone: what is beside it
moves M without evidence. The correction is then moved along what is open until M stays where it was.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.guard import slopes_of
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import AS_GOOD_AS, LEAST_NOISE
from processing.diagnosis.search.solution import Solution

#: Weights of the change of M that are tried, each ten times the one before.
WEIGHTS = 10.0 ** np.arange(2, 16)


def without_change(problem: InstrumentProblem, found: Posterior, solved: Solution) -> Posterior | None:
    """The posterior with values that are as good and do not change M; None where there are none."""
    slopes = slopes_of(problem, found, solved)
    if slopes is None:
        return None
    index, own = slopes.index[slopes.applied], np.ix_(slopes.applied, slopes.applied)
    moved = least_change(found.values[index], found.covariance[np.ix_(index, index)], slopes.products[own])
    if moved is None:
        return None
    values = found.values.copy()
    values[index] = moved
    return replace(found, values=values)


def least_change(mean: Array, covariance: Array, products: Array) -> Array | None:
    """Values (K,) near the mean of a posterior that hardly change M; None where they are too far from it.

    `products` (K, K) of the slopes of M/m00, averaged.
    """
    across = covariance @ products
    for weight in WEIGHTS:
        values = np.linalg.solve(np.eye(mean.size) + weight * across, mean)
        # The step is covariance @ products @ values, times the weight: its length in standard deviations.
        pull = products @ values
        if weight * np.sqrt(max(float(pull @ covariance @ pull), 0.0)) > AS_GOOD_AS:
            return None
        if float(values @ products @ values) <= LEAST_NOISE**2:
            return np.asarray(values)
    return None
