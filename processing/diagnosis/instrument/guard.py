"""Nothing is written that makes a measurement worse: figures before and after a correction."""

from __future__ import annotations

import numpy as np

from processing.diagnosis.instrument.mueller_slopes import mueller_slopes
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.systematic import ELEMENTS
from processing.diagnosis.search.fit import Fit
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.result import Check
from processing.diagnosis.search.rules import WORSE, WORSE_CONDITION
from processing.diagnosis.search.solution import Solution
from processing.diagnosis.search.space import Space
from processing.instrument.effects.base import FieldEffect, Switch

#: Singular values below this, relative to the largest, are none.
RANK = 1e-6


def checks(problem: InstrumentProblem, found: Posterior, solved: Solution) -> tuple[Check, ...]:
    """Held-out residual, predicted error of M, rank and condition of W, before and after."""
    stretch = _stretch(problem, solved)
    before, after = 100 * solved.before.rms, 100 * solved.after.rms / stretch
    out = [
        Check(
            name="rms on held-out data, percent of the mean signal",
            before=before,
            after=after,
            holds=bool(after <= WORSE * before),
        )
    ]
    told, off = predicted_error(problem, found, solved)
    out.append(Check(name="predicted error of M/m00, rms", before=off, after=told, holds=bool(told <= off)))
    for k, data in enumerate(problem.captures):
        (rank, condition), (new_rank, new_condition) = (
            _of_rows(problem, k, space, fit)
            for space, fit in ((solved.base, solved.before_fit), (solved.space, solved.fit))
        )
        where = f"of the measurement matrix of {data.name}"
        out.append(Check(name=f"rank {where}", before=rank, after=new_rank, holds=new_rank >= rank))
        out.append(
            Check(
                name=f"condition {where}",
                before=condition,
                after=new_condition,
                holds=bool(new_condition <= WORSE_CONDITION * condition),
            )
        )
    return tuple(out)


def predicted_error(problem: InstrumentProblem, found: Posterior, solved: Solution) -> tuple[float, float]:
    """Rms error of M/m00 of these captures that the posterior expects with the correction, and without it."""
    part = dict(zip(found.space.candidates, found.space.slices, strict=True))
    space = Space(tuple(c for c in solved.effects if not isinstance(c.effect, FieldEffect | Switch)))
    if not space.size:
        return 0.0, 0.0
    index = np.concatenate([np.r_[part[c]] for c in space.candidates])
    mean = found.values[index]
    products, light = mueller_slopes(problem, space, mean)
    left = float(np.sum(products * found.covariance[np.ix_(index, index)]))
    removed = float(mean @ products @ mean)
    scale = max(light, 1e-300) * ELEMENTS
    return float(np.sqrt(max(left, 0.0) / scale)), float(np.sqrt(max(left + removed, 0.0) / scale))


def refusal(found: tuple[Check, ...]) -> str | None:
    """Why a correction is not written, in words; None if every figure holds."""
    worse = [f"{c.name}: {c.before:.4g} to {c.after:.4g}" for c in found if not c.holds]
    return "it would make worse: " + "; ".join(worse) if worse else None


def _stretch(problem: InstrumentProblem, solved: Solution) -> float:
    """By how much a bend of the response stretches noise, and residual, relative to the signal."""
    if not problem.noise_known:
        return 1.0
    before = problem.near(solved.base, solved.before_fit.values)[0]
    after = problem.near(solved.space, solved.fit.values)[0]
    old, new = (float(np.mean([m.noise_floor**2 for m in p.moments])) for p in (before, after))
    return float(np.sqrt(new / old)) if old > 0 else 1.0


def _of_rows(problem: InstrumentProblem, k: int, space: Space, fit: Fit) -> tuple[int, float]:
    changes = problem.changes(k, space, fit.values)
    w = problem.models[k].rows(problem.captures[k].conditions.angles_deg, changes).reshape(-1, 16)
    size = np.linalg.svd(w, compute_uv=False)
    size = size[size > RANK * size[0]]
    return size.size, float(size[0] / size[-1])
