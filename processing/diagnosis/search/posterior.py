"""The posterior of all effects at once: linearize, select groups, improve the solution, and repeat.

Every effect at every place takes part from the beginning, so no order of adding matters. Values of one kind in several
captures are one group; a slip is one of as many rivals as there are states.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.averages import Samples, likely_starts, stay
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.descent import (
    all_at_once,
    alone,
    descend,
    mean_over_sets,
    minimum_of,
    next_values,
)
from processing.diagnosis.search.likely_set import likely_set
from processing.diagnosis.search.linearization import group_candidates, noise_of, quadratic
from processing.diagnosis.search.rules import (
    ALTERNATIVE,
    BENT,
    CHANGES,
    FAR,
    GROWTH,
    NEEDED,
    ROUNDS,
    SURE,
)
from processing.diagnosis.search.sets import Group, Sets, State
from processing.diagnosis.search.space import Problem, Space

#: Called with a line about the present step.
Say = Callable[[str], None]


@dataclass(frozen=True)
class Posterior:
    """Posterior of the parameters of all candidates.

    Attributes
    ----------
    space : all candidates; members : numbers of the candidates of each group.
    sets, samples : the last linearization, and the sets that were visited in it.
    rivals : for each present group, alternatives that fit equally well when each is linearized about its own values.
    values : (K,) mean; covariance : (K, K), both in the units of the parameters.
    """

    space: Space
    members: tuple[tuple[int, ...], ...]
    sets: Sets
    samples: Samples
    values: Array
    covariance: Array
    rivals: Mapping[int, tuple[int, ...]]

    @property
    def score(self) -> float:
        """Log probability of the likeliest set, a constant left out."""
        return self.sets.score(self.samples.best)

    @property
    def any_cause(self) -> bool:
        """Whether some group that the data support is there for sure, be it that none is by itself."""
        return self.samples.any_supported >= SURE

    @property
    def free_groups(self) -> list[int]:
        """Groups of the likeliest set that might be absent."""
        return [int(k) for k in np.flatnonzero((self.samples.best.tau > 0) & self.sets.free)]

    def of_likeliest(self) -> tuple[Array, Array]:
        """Values (K,) and covariance (K, K) of the likeliest set alone, in the units of the parameters."""
        typical, fit = self.space.joined("typical"), self.sets.fitted(self.samples.best)
        values, covariance = np.zeros(typical.size), np.zeros((typical.size, typical.size))
        values[fit.active], covariance[np.ix_(fit.active, fit.active)] = fit.mean, fit.covariance
        return values * typical, covariance * np.outer(typical, typical)

    def along(self, direction: Array) -> tuple[Array, Array, Array]:
        """Share (S,), mean (S,) and standard deviation (S,) of a sum of values with weights (K,), in each set."""
        scaled = direction * self.space.joined("typical")
        share, mean, stderr = self.samples.along(scaled)
        # Of a bent valley the mean over the sets is not the one of the straight line.
        return share, mean + float(direction @ self.values - scaled @ self.samples.mean), stderr

    def label(self, group: int) -> Candidate:
        """A candidate that stands for a group."""
        return self.space.candidates[self.members[group][0]]


def fit_posterior(
    problem: Problem,
    space: Space,
    fixed: Sequence[Candidate],
    starts: Sequence[Array],
    *,
    say: Say,
    far: Collection[Candidate] = (),
) -> Posterior:
    """The posterior of all values of a space.

    Parameters
    ----------
    fixed : candidates that are always there (nominal values of the train, switches that are on).
    starts : values (K,) to begin with, the declared ones first.
    far : candidates whose values may be beyond the plausible.
    """
    members, groups = group_candidates(space, fixed, far)
    about, sets, state, rivals = _expand(problem, space, fixed, members, groups=groups, starts=starts, say=say)
    say("averaging over sets of causes")
    samples = stay(sets, likely_starts(sets, state), CHANGES)
    labels = [space.candidates[members[g][0]].label for g in np.flatnonzero((samples.probability > 0.5) & sets.free)]
    say(f"likely: {', '.join(labels) or 'nothing'}; unit of chi-square {state.unit:.3g}")
    return posterior_of(problem, space, members, sets, samples=samples, about=about, rivals=rivals)


@dataclass(frozen=True, eq=False)
class _Round:
    """The problem linearized `about` values (K,), with the `excess` there, and a likely set in it."""

    about: Array
    excess: float
    sets: Sets
    state: State

    @property
    def score(self) -> float:
        return self.sets.score(self.state)


#: Linearizes about values (K,), and finds a set; None where the model has no intensities.
Look = Callable[[Array], _Round | None]


def _expand(
    problem: Problem,
    space: Space,
    fixed: Sequence[Candidate],
    members: Sequence[tuple[int, ...]],
    *,
    groups: Sequence[Group],
    starts: Sequence[Array],
    say: Say,
) -> tuple[Array, Sets, State, dict[int, tuple[int, ...]]]:
    """Values (K,) about which it was linearized, the sets there, the likeliest of them, and what does as well."""

    number = count(1)

    def look(x: Array) -> _Round | None:
        say(f"round {next(number)}: looking for likely causes")
        problem.relinearize(space, x)
        sums = problem.sums(space, x)
        form = quadratic(problem, space, x, sums)
        if not (np.isfinite(form.excess) and np.all(np.isfinite(form.curvature))):
            return None
        sets = Sets(form, groups, noise_of(problem, sums))
        return _Round(x, form.at(x / space.joined("typical")), sets, likely_set(sets))

    looks = [trial for trial in map(look, starts) if trial is not None]
    assert looks, "the instrument as declared has no intensities"
    first = max(looks, key=lambda trial: trial.score)
    begun = _likely_begins(problem, space, fixed, members, first=first, start=starts[0], look=look)
    ended: list[_Round] = []
    for trial in begun:
        # What another start has reached is not sought again.
        if all(trial.score > other.score for other in ended):
            ended.append(_settle(problem, space, trial, look))
    last = max(ended, key=lambda trial: trial.score)
    problem.relinearize(space, last.about)
    down = problem.noise_known and last.state.unit <= BENT
    bends = [g for g, indices in enumerate(members) if space.candidates[indices[0]].is_pointwise]
    # With structure the nearest effects describe it, so their alternatives are not compared so closely.
    last, rivals = _of_bends(problem, space, last, bends if down else (), look=look)
    return last.about, last.sets, last.state, rivals


def _likely_begins(
    problem: Problem,
    space: Space,
    fixed: Sequence[Candidate],
    members: Sequence[tuple[int, ...]],
    *,
    first: _Round,
    start: Array,
    look: Look,
) -> list[_Round]:
    """Rounds to go on from: the `first`, about values (K,) `start`, and others that may lead to a likelier set."""
    if first.state.unit > BENT or not problem.noise_known:
        # Several large causes, none of which explains much alone, or far from linear: from all of them at once as well.
        values = [all_at_once(problem, space, fixed, start, noise=first.sets.noise, tau=FAR)]
        bent = [g for g, indices in enumerate(members) if space.candidates[indices[0]].effect.has_bent_valley]
        rounds = map(look, values + [alone(problem, space, members[g]) for g in bent])
        return [max([first, *(r for r in rounds if r is not None)], key=lambda r: r.score)]
    # One large cause: many others can explain it together, from which no straight line leads back to it.
    odds = np.where(first.sets.free, first.sets.conditional(first.sets.empty(), follow=True).log_odds, -np.inf)
    if not odds.max() > NEEDED:
        return [first]
    by_itself = look(alone(problem, space, members[int(np.argmax(odds))]))
    return [first, by_itself] if by_itself is not None and by_itself.score > first.score else [first]


def _of_bends(
    problem: Problem, space: Space, first: _Round, bends: Sequence[int], *, look: Look
) -> tuple[_Round, dict[int, tuple[int, ...]]]:
    """The likeliest of this round and of rounds in which one of the `bends` (groups) replaces a present one.

    Corrections of counts are expanded about the current values, where the right one may look worse than a wrong one.
    Also returns the alternatives that fit equally well about their own values.
    """
    rounds, noise = [first], first.sets.noise
    enough = noise.log_likelihood(first.sets.fitted(first.state).excess) - 2 * NEEDED
    for k in (g for g in bends if first.state.tau[g] > 0):
        for j in (g for g in bends if first.state.tau[g] == 0):
            state = first.sets.without(first.state, k)
            state.tau[j] = first.state.tau[k]
            values, excess = minimum_of(problem, space, first.sets, first.sets.settled(state))
            # What fits far worse about its own values is no alternative, whatever other groups may add.
            trial = look(values) if noise.log_likelihood(excess) > enough else None
            rounds += [trial] if trial is not None else []
    best = max(rounds, key=lambda trial: trial.score)
    problem.relinearize(space, best.about)

    def groups_in(trial: _Round) -> set[int]:
        return {g for g in bends if trial.state.tau[g] > 0}

    # The noise was computed with the first of them, which is therefore preferred by more than its evidence.
    least, best_groups = best.score - 2 * NEEDED, groups_in(best)
    likely = [groups_in(trial) for trial in rounds if trial.score > least]
    return best, {k: tuple(sorted({j for on in likely if k not in on for j in on - best_groups})) for k in best_groups}


def _settle(problem: Problem, space: Space, first: _Round, look: Look) -> _Round:
    """Linearize again about the new values until they converge.

    The iteration stops when a round about a solution is not likelier than the one before: the scores then scatter with
    the chain. It also stops far below an earlier round that left what it predicted: poorly determined values can drift
    together, out of the range of the linearization.
    """
    now, verified, reached = first, -np.inf, -np.inf
    for _ in range(ROUNDS - 1):
        x, settled = next_values(problem, space, now.sets, now.state, x=now.about)
        if settled:
            break
        new = look(x)
        if new is None:
            break
        noise, prediction = now.sets.noise, now.sets.form.at(x / space.joined("typical"))
        if noise.unit(new.excess) <= GROWTH * noise.unit(prediction):
            verified = max(verified, now.score)
        if new.score < verified - ALTERNATIVE or new.score <= reached:
            break
        now, reached = new, new.score
    problem.relinearize(space, now.about)
    return now


def posterior_of(
    problem: Problem,
    space: Space,
    members: tuple[tuple[int, ...], ...],
    sets: Sets,
    *,
    samples: Samples,
    about: Array,
    rivals: Mapping[int, tuple[int, ...]],
) -> Posterior:
    """The posterior of a problem linearized `about` values (K,)."""
    typical, values = space.joined("typical"), mean_over_sets(space, samples, np.ones(space.size))
    sums = problem.sums(space, values, derivatives=False)
    if not sets.noise.unit(sums.chi2(problem.noise_known)) <= GROWTH * sets.noise.unit(sets.form.at(values / typical)):
        # The least certain values lie along a bent valley, in which the straight line to their mean does not stay.
        values = descend(problem, space, sets.groups, samples, starts=[about])
    return Posterior(space, members, sets, samples, values, samples.covariance * np.outer(typical, typical), rivals)
