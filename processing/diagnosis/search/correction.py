"""The correction of a posterior: the mean of the groups that are likely enough, and its predictions."""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import causes
from processing.diagnosis.search.fit import Fit, Solution, held_out, minimize
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import LIKELY, LITTLE, MISSED, SURE
from processing.diagnosis.search.sets import Quadratic
from processing.diagnosis.search.space import Problem, Space


def applied(posterior: Posterior, base: Space, unfit: Collection[Candidate] = ()) -> tuple[Space, Array]:
    """Space and values of the correction: the posterior mean of the groups that are likely enough."""
    keep = set(base.candidates)
    by_label = {posterior.label(g): g for g in range(len(posterior.members))}
    for cause in causes(posterior, 0.0):
        # That one of a class is there can be certain while none of it is likely by itself: each gets its share.
        if cause.probability >= LIKELY:
            shares = [by_label[c] for c in cause.alternatives if posterior.samples.probability[by_label[c]] > 1 - SURE]
            keep.update(cause.candidates, (posterior.space.candidates[m] for g in shares for m in posterior.members[g]))
    for g in _groups(posterior, keep):
        keep |= {posterior.space.candidates[m] for m in posterior.members[g]}
    keep -= set(unfit)
    order = [*base.candidates, *(c for c in posterior.space.candidates if c in keep and c not in base.candidates)]
    space = Space(tuple(order))
    return space, space.vector(posterior.space.split(posterior.values))


def _groups(posterior: Posterior, keep: Collection[Candidate]) -> NDArray[np.int64]:
    """Groups of `keep`, those that are likely enough, and further ones without which the fit gets worse."""
    candidates, samples = posterior.space.candidates, posterior.samples
    kept = samples.takes_part | [all(candidates[k] in keep for k in members) for members in posterior.members]
    mean = posterior.values / posterior.space.joined("typical")
    index = [posterior.space.positions(members) for members in posterior.members]
    return needed_groups(posterior.sets.form, mean, index, kept=kept, most=MISSED * samples.best.unit)


def needed_groups(
    form: Quadratic, mean: Array, index: Sequence[NDArray[np.int64]], *, kept: NDArray[np.bool_], most: float
) -> NDArray[np.int64]:
    """Groups with which a correction by a mean (K,) has a chi-square within `most` of that of the whole mean.

    Several groups that are unlikely one by one can be one cause together: the mean has a part of each, and these parts
    fit only together. So groups are left out, the one that is missed least first, and never one that is `kept` (G,).
    `index` has the positions of the values of each group.
    """
    group = np.zeros(mean.size, dtype=np.int64)
    for g, positions in enumerate(index):
        group[positions] = g
    own = np.array([mean[i] @ form.curvature[np.ix_(i, i)] @ mean[i] for i in index])
    x, loss, is_needed = mean.copy(), 0.0, np.ones(len(index), dtype=bool)
    while (may_go := is_needed & ~kept).any():
        slope = mean * (form.gradient + form.curvature @ x)
        missed = np.where(may_go, own - 2 * np.bincount(group, slope, len(index)), np.inf)
        g = int(np.argmin(missed))
        loss += missed[g]
        if loss > most:
            break
        x[index[g]], is_needed[g] = 0.0, False
    return np.flatnonzero(is_needed)


def solution(
    problem: Problem, posterior: Posterior, base: Space, start: Array, *, unfit: Collection[Candidate] = ()
) -> Solution:
    """The correction of a posterior, without the `unfit` candidates, and how well it predicts held-out data.

    `base` is always fitted, from `start` (K,) on.
    """
    base_fit, unit = minimize(problem, base, start), posterior.samples.best.unit
    of_base = posterior.sets.noise.unit(base_fit.sums.chi2(problem.noise_known))
    before = held_out(problem, base, base_fit, unit=of_base)
    space, values = applied(posterior, base, unfit)
    problem.relinearize(space, values)
    sums = problem.sums(space, values)
    fit = Fit(values, sums, float(sums.excess.sum()))
    typical = space.joined("typical")
    spread = space.vector(posterior.space.split(np.diag(posterior.covariance)))
    weak = unit / np.maximum(np.sqrt(spread + values**2), LITTLE * typical) ** 2
    return Solution(base, base_fit, before, space, fit, held_out(problem, space, fit, weak, unit=unit), weak)
