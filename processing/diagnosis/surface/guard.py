"""What a correction of material, geometry or instrument does to the captures of an object, and to xi0."""

from __future__ import annotations

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.decision import PredictedChange, chance_checks, held_out_check, rows_checks
from processing.diagnosis.search.fit import Solution
from processing.diagnosis.search.result import Check
from processing.diagnosis.search.space import Space
from processing.diagnosis.surface.problem import SurfaceProblem
from processing.diagnosis.surface.quantities import xi0_of


def checks(problem: SurfaceProblem, solved: Solution) -> tuple[Check, ...]:
    """Held-out residual before and after; where the optics are corrected, rank and condition of W too."""
    out = [held_out_check(solved)]
    if any(c.of_instrument for c in solved.effects):
        for k, data in enumerate(problem.captures):
            before, after = (
                problem.rows(k, problem.changes(k, space, fit.values)[0])
                for space, fit in ((solved.base, solved.before_fit), (solved.space, solved.fit))
            )
            out += rows_checks(data.name, before, after)
    return tuple(out)


def chances(problem: SurfaceProblem, solved: Solution, covariance: Array) -> tuple[Check, ...]:
    """What the correction does to xi0, where its values have a covariance (K, K); none where no pixel shows xi0."""
    if not solved.effects:
        return ()
    change = change_of_xi0(problem, solved, covariance)
    return () if change is None else chance_checks("xi0", change)


def change_of_xi0(problem: SurfaceProblem, solved: Solution, covariance: Array) -> PredictedChange | None:
    """The change of xi0 and its error, which is that at both ends of every principal axis of the values.

    Slopes at what was found do not tell it: the model is far from linear, and values have bounds.
    """
    space, values = solved.space, solved.fit.values
    found = _xi0(problem, space, values)
    change = found - _xi0(problem, space, np.zeros(space.size))
    if not np.isfinite(change).any():
        return None
    size = float(np.sqrt(_mean(change**2)))
    along, whole = 0.0, 0.0
    lower, upper = space.joined("lower"), space.joined("upper")
    variance, axes = np.linalg.eigh(covariance)
    for one in (np.sqrt(np.maximum(variance, 0.0)) * axes).T:
        ends = [_xi0(problem, space, np.clip(values + sign * one, lower, upper)) - found for sign in (1, -1)]
        whole += sum(_mean(end**2) for end in ends) / 2
        along += sum(_mean(end * change) ** 2 for end in ends) / 2 / max(size, 1e-300) ** 2
    return PredictedChange(float(np.hypot(size, np.sqrt(whole))), float(np.sqrt(whole)), size, size, float(along**0.5))


def _xi0(problem: SurfaceProblem, space: Space, values: Array) -> Array:
    return np.concatenate([xi0_of(problem, k, space, values) for k in range(len(problem.captures))])


def _mean(x: Array) -> float:
    """Over the pixels that show xi0."""
    shown = x[np.isfinite(x)]
    return float(shown.mean()) if shown.size else 0.0
