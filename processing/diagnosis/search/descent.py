"""Descent to the minimum of chi-square and prior, anew linearized on the way."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.averages import Samples, stay
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import minimize
from processing.diagnosis.search.rules import CHANGES_BEFORE, EXACT, LITTLE, NOMINAL_TAU, ROUNDS
from processing.diagnosis.search.sets import Group, Noise, Sets, State
from processing.diagnosis.search.space import Problem, Space


def all_at_once(
    problem: Problem, space: Space, fixed: Sequence[Candidate], x: Array, *, noise: Noise, tau: float
) -> Array:
    """Values (K,) with every group there and `tau` typical sizes wide, but those that are one of many alternatives."""
    chosen = [k for k, c in enumerate(space.candidates) if not c.state_chosen and not c.price]
    part = Space(tuple(space.candidates[k] for k in chosen))
    positions = space.positions(chosen)
    always = np.concatenate([np.full(c.size, c in fixed) for c in part.candidates])
    width = part.joined("typical") * np.where(always, NOMINAL_TAU, tau)
    values = x[positions]
    for _ in range(ROUNDS):
        sums = problem.sums(part, values, derivatives=False)
        unit = noise.unit(sums.chi2(problem.noise_known))
        new = minimize(problem, part, values, steps=3, expansions=0, weak=unit / width**2, unit=unit).values
        moved, values = np.max(np.abs(new - values) / width), new
        if not problem.relinearize(part, values) and moved < EXACT:
            break
    start_values = x.copy()
    start_values[positions] = values
    return start_values


def alone(problem: Problem, space: Space, chosen: Sequence[int]) -> Array:
    """Values (K,) of some candidates, by their numbers, at their own minimum; all others at zero."""
    part = Space(tuple(space.candidates[k] for k in chosen))
    return space.vector(part.split(minimize(problem, part, np.zeros(part.size)).values))


def next_values(problem: Problem, space: Space, sets: Sets, state: State, *, x: Array) -> tuple[Array, bool]:
    """Values (K,) about which to linearize next, and whether they are so near to x (K,) that there is no need."""
    samples = stay(sets, [(state, 1.0)], CHANGES_BEFORE)
    new = descend(problem, space, sets.groups, samples, starts=[mean_over_sets(space, samples, x), x])
    spread = np.sqrt(np.maximum(np.diag(samples.covariance), 1e-12)) * space.joined("typical")
    return new, bool(np.all(np.abs(new - x) < EXACT * spread))


def mean_over_sets(space: Space, samples: Samples, x: Array) -> Array:
    """Values (K,), mean over the sets; values that are not fitted are those of x (K,)."""
    typical, lower, upper = (space.joined(name) for name in ("typical", "lower", "upper"))
    return np.where(space.fixed, x, np.clip(samples.mean * typical, lower, upper))


def descend(
    problem: Problem,
    space: Space,
    groups: Sequence[Group],
    samples: Samples,
    *,
    starts: Sequence[Array],
) -> Array:
    """Values (K,) at the minimum of chi-square and prior, of the groups that are likely to be there.

    The descent begins at the best of some places (K,).
    """
    part, positions = _part_of(space, [g for g, on in zip(groups, samples.takes_part, strict=True) if on])
    typical = space.joined("typical")[positions]
    width = np.sqrt(np.diag(samples.covariance) + samples.mean**2)[positions] * typical
    weak = samples.best.unit / np.maximum(width, LITTLE * typical) ** 2
    values = np.where(space.fixed, starts[0], 0.0)
    if positions.size:
        places = [x[positions] for x in starts]
        chi2 = [problem.sums(part, x, derivatives=False).excess.sum() + weak @ x**2 for x in places]
        best = places[int(np.argmin(np.nan_to_num(chi2, nan=np.inf)))]
        values[positions] = minimize(problem, part, best, expansions=0, weak=weak, unit=samples.best.unit).values
    return values


def minimum_of(problem: Problem, space: Space, sets: Sets, state: State) -> tuple[Array, float]:
    """Values (K,) at the minimum of chi-square and prior of one set, and the minimum.

    The descent begins where the minimum is if the problem is linear.
    """
    fit, on = sets.fitted(state), state.tau > 0
    part, positions = _part_of(space, [g for g, is_on in zip(sets.groups, on, strict=True) if is_on])
    linear, tau = np.zeros(space.size), np.zeros(space.size)
    linear[fit.active] = fit.mean
    for k in np.flatnonzero(on):
        tau[sets.groups[k].index] = state.tau[k]
    typical = space.joined("typical")
    values = np.zeros(space.size)
    weak = state.unit / (tau * typical)[positions] ** 2
    start = (linear * typical)[positions]
    minimum = minimize(problem, part, start, expansions=0, weak=weak, unit=state.unit)
    values[positions] = minimum.values
    return values, minimum.sums.chi2(problem.noise_known) + float(weak @ minimum.values**2)


def _part_of(space: Space, groups: Sequence[Group]) -> tuple[Space, NDArray[np.int64]]:
    """The candidates of some groups, and their positions (J,) in the common vector."""
    index = {int(i) for g in groups for i in g.index}
    chosen = [k for k, part in enumerate(space.slices) if part.start in index]
    return Space(tuple(space.candidates[k] for k in chosen)), space.positions(chosen)
