"""The correction of a posterior: the mean of the groups that are likely enough, and its predictions."""

from collections.abc import Collection

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import causes
from processing.diagnosis.search.fit import Fit, Solution, held_out, minimize
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import LIKELY, LITTLE, SLACK, SURE
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
    """Groups in addition to `keep` that are likely enough, and further groups without which the fit gets worse.

    Several groups that are unlikely one by one can be one cause together: the mean has a part of each, and these parts
    fit only together.
    """
    space, form = posterior.space, posterior.sets.form
    samples = posterior.samples
    order = np.lexsort((-samples.probability, ~samples.takes_part))
    is_used = np.concatenate([np.zeros(0, dtype=bool), *(np.full(c.size, c in keep) for c in space.candidates)])
    mean = posterior.values / space.joined("typical")
    chi2_at_mean = form.at(mean)
    groups: list[int] = []
    for g in order:
        loss = form.at(np.where(is_used, mean, 0.0)) - chi2_at_mean
        if not samples.takes_part[g] and loss <= SLACK**2 * samples.best.unit:
            break
        groups.append(int(g))
        for m in posterior.members[g]:
            is_used[space.slices[m]] = True
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
