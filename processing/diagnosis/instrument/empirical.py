"""A correction that takes structure away without saying what it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.result import Empirical
from processing.diagnosis.search.rules import ALSO, ALSO_FITS, EMPIRICAL_SHARE, TAU
from processing.diagnosis.search.solution import Solution
from processing.instrument.effects.base import GeneralEffect


def empirical(found: Posterior, solved: Solution) -> Empirical | None:
    """The best of: a gain for each state, an angle for each state, a bend of the response; last linearization."""
    part = dict(zip(found.space.candidates, found.space.slices, strict=True))
    plain = [c for c in solved.space.candidates if not isinstance(c.effect, GeneralEffect)]
    beside = np.concatenate([np.zeros(0, dtype=np.int64), *(np.r_[part[c]] for c in plain)]).astype(np.int64)
    before, _ = _left(found, beside)
    fits: list[tuple[float, Candidate, Array]] = []
    for candidate, mine in part.items():
        if isinstance(candidate.effect, GeneralEffect):
            left, x = _left(found, np.concatenate([beside, np.r_[mine]]))
            fits.append((left, candidate, x[beside.size :] * candidate.typical))
    if not fits:
        return None
    left, best, values = min(fits, key=lambda f: f[0])
    if left > (1 - EMPIRICAL_SHARE) * before or not isinstance(best.effect, GeneralEffect):
        return None
    freedom = found.sets.noise.slack + ALSO * (before - left)
    total = max(solved.before.excess + solved.before.freedom, 1e-300)
    share = max(left + (solved.before.freedom if found.sets.noise.known else 0.0), 0.0) / total
    return Empirical(
        kind=best.effect.describes,
        rms_percent_in_sample=100 * solved.before.rms * float(np.sqrt(share)),
        values=tuple(values.tolist()),
        unit=best.parameters[0].unit,
        would_also_fit=tuple(dict.fromkeys(c.short for e, c, _ in fits if e <= left + ALSO_FITS * freedom)),
    )


def _left(found: Posterior, index: NDArray[np.int64]) -> tuple[float, Array]:
    """Excess that some values leave, each held by the widest prior, and the values in typical sizes."""
    form = found.sets.form
    g, h = form.gradient[index], form.curvature[np.ix_(index, index)]
    x = -np.linalg.solve(h + np.eye(index.size) * found.samples.best.unit / TAU[-1] ** 2, g)
    return float(form.excess + 2 * g @ x + x @ h @ x), x
