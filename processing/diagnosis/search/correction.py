"""The correction of a posterior: the mean of the groups that are likely enough, and its predictions."""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import causes
from processing.diagnosis.search.fit import Fit, Solution, held_out, minimize
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import LIKELY, LITTLE, SURE
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
    for g in _least_needed(posterior, keep):
        keep |= {posterior.space.candidates[m] for m in posterior.members[g]}
    keep -= set(unfit)
    order = [*base.candidates, *(c for c in posterior.space.candidates if c in keep and c not in base.candidates)]
    space = Space(tuple(order))
    return space, space.vector(posterior.space.split(posterior.values))


def _least_needed(posterior: Posterior, keep: Collection[Candidate]) -> list[int]:
    """Groups in addition to `keep` that are likely enough, and further groups without which the fit gets worse."""
    space, samples = posterior.space, posterior.samples
    likely = np.flatnonzero(samples.takes_part)
    index = [space.positions(members) for members in posterior.members]
    is_used = np.concatenate([np.zeros(0, dtype=bool), *(np.full(c.size, c in keep) for c in space.candidates)])
    for g in likely:
        is_used[index[g]] = True
    mean = posterior.values / space.joined("typical")
    needed = most_needed(posterior.sets.form, mean, index, is_used=is_used, most=samples.best.unit)
    return [*likely.tolist(), *needed]


def most_needed(
    form: Quadratic, mean: Array, index: Sequence[NDArray[np.int64]], *, is_used: Array, most: float
) -> list[int]:
    """Groups that a correction by a mean (K,) needs, so that chi-square is within `most` of that at the mean.

    Several groups that are unlikely one by one can be one cause together: the mean has a part of each, and these parts
    fit only together. The group that takes most away comes first. `index` holds the values of each group, and `is_used`
    (K,) those that are corrected already.
    """
    own = np.array([mean[i] @ form.curvature[np.ix_(i, i)] @ mean[i] for i in index])
    own[[bool(is_used[i].all()) for i in index]] = np.inf
    x, chi2_at_mean = np.where(is_used, mean, 0.0), form.at(mean)
    groups: list[int] = []
    for _ in index:
        if form.at(x) - chi2_at_mean <= most:
            break
        slope = 2 * (form.gradient + form.curvature @ x) * mean
        g = int(np.argmin(own + [float(slope[i].sum()) for i in index]))
        groups.append(g)
        x[index[g]], own[g] = mean[index[g]], np.inf
    return groups


def solution(
    problem: Problem, posterior: Posterior, base: Space, start: Array, *, unfit: Collection[Candidate] = ()
) -> Solution:
    """The correction of a posterior, without the `unfit` candidates, and how well it predicts held-out data.

    `base` is always fitted, from `start` (K,) on.
    """
    base_fit = minimize(problem, base, start)
    before = held_out(problem, base, base_fit)
    space, values = applied(posterior, base, unfit)
    problem.relinearize(space, values)
    sums = problem.sums(space, values)
    fit = Fit(values, sums, float(sums.excess.sum()))
    typical = space.joined("typical")
    spread = space.vector(posterior.space.split(np.diag(posterior.covariance)))
    weak = posterior.samples.best.unit / np.maximum(np.sqrt(spread + values**2), LITTLE * typical) ** 2
    return Solution(base, base_fit, before, space, fit, held_out(problem, space, fit, weak), weak)
