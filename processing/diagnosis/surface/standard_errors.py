"""Standard errors of what was found in the reflectance, where the model is far from linear."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.fit import Fit, minimize, prior
from processing.diagnosis.search.rules import SHOWN
from processing.diagnosis.search.space import Space
from processing.diagnosis.surface.problem import SurfaceProblem

#: [doublings] By which an error may grow at most as a bent valley asks.
MOST_DOUBLINGS = 5

#: [typical sizes] From its bound up to which a value stands at it.
AT_BOUND = 1e-6
#: [steps] Of a fit of all other values.
STEPS = 5


def standard_errors(problem: SurfaceProblem, space: Space, fit: Fit, spread: float) -> Array:
    """Standard errors (K,) of the values; `spread` scales the noise where structure is left over.

    The noise of alpha_0 adds to the scatter of the gradient, not to the slope. A valley may be bent, and wider than its
    curvature at the bottom says: an error is a third of the way to where the excess, with all other values fitted anew,
    has risen by what the curvature promises for three.
    """
    if not space.size:
        return np.zeros(0)
    both, bread = _covariance(space, fit, problem.noise_information(space, fit.values))
    error = np.sqrt(np.maximum(np.diag(both), 0.0))
    wide = np.ones(space.size)
    for j in np.flatnonzero(bent(space)):
        step = SHOWN * error[j]
        wide[j] = _wide(problem, space, fit, int(j), step=step, promised=step**2 / max(bread[j, j], 1e-300))
    return np.asarray(error * wide * np.sqrt(spread))


def _covariance(space: Space, fit: Fit, noise_only: Array) -> tuple[Array, Array]:
    """Covariance (K, K) of the values of a fit, for noise of one; and the inverse (K, K) of the gradient's slope.

    The part `noise_only` (K, K) of the curvature comes from noise in the derivatives: it adds to the scatter of the
    gradient, not to its slope.
    """
    weak = np.diag(prior(space))
    raw = fit.sums.curvature.sum(axis=0) + weak
    told = raw - noise_only
    bread = np.linalg.inv(told if space.size and np.linalg.eigvalsh(told).min() > 0 else raw)
    return bread @ raw @ bread, bread


def bent(space: Space) -> NDArray[np.bool_]:
    """(K,) values of effects whose valley is bent."""
    return np.array([c.effect.has_bent_valley for c in space.candidates for _ in c.parameters], dtype=bool)


def _wide(problem: SurfaceProblem, space: Space, fit: Fit, j: int, *, step: float, promised: float) -> float:
    """Factor on a step of value j that makes the excess rise as promised, on the flatter side."""
    lower, upper = space.joined("lower")[j], space.joined("upper")[j]
    others = np.arange(space.size) != j
    # A value that stands at its bound may not want to leave it by itself.
    edges = np.minimum(fit.values - space.joined("lower"), space.joined("upper") - fit.values)
    inner = np.where(edges > AT_BOUND * space.joined("typical"), fit.values, 0.0)
    last, wide = 0.0, 1.0
    while True:
        ends = [x for x in fit.values[j] + wide * step * np.array([1.0, -1.0]) if lower <= x <= upper]
        if not ends:
            return wide
        lowest = np.inf
        for end in ends:
            start = inner.copy()
            start[j] = end
            lowest = min(lowest, minimize(problem, space, start, free=others, steps=STEPS).excess)
        rise = lowest - fit.excess
        if rise >= promised or wide >= 2**MOST_DOUBLINGS:
            low = wide / 2 if wide > 1 else 0.0
            part = (promised - last) / max(rise - last, promised - last, 1e-300)
            return max(1.0, low + (wide - low) * part)
        last, wide = rise, 2 * wide
