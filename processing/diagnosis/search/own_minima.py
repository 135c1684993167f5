"""Sets of groups where the model is far from linear: every set is linearized about its own minimum.

The evidence of a set is then that of its own fit (Laplace's approximation), and no set is judged by the slopes of
another one. Each costs a fit, so sets are few: from nothing, the change of one group that gains most, as long as one
gains; then every group of the likeliest set is exchanged for every other that promises as much.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.averages import Samples
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import Fit, minimize
from processing.diagnosis.search.likely_set import retune
from processing.diagnosis.search.linearized import grouped, noise_of, quadratic
from processing.diagnosis.search.posterior import Posterior, Say
from processing.diagnosis.search.rules import ALTERNATIVE, BOUND, EXPLAINS, IMITATES
from processing.diagnosis.search.sets import Group, Sets, State
from processing.diagnosis.search.space import Problem, Space

#: [groups] That are fitted beside a set of effects of a surface: what one step promises says little there.
LEADERS = 12
#: [unit of chi-square] A fit of a set ends when a step gains less, and a far start is taken that gains more.
ENOUGH = 0.05


@dataclass(frozen=True, eq=False)
class Visited:
    """One set at its own minimum.

    Attributes
    ----------
    groups : numbers of the groups that are there.
    space, fit : their parameters at the minimum.
    sets, state : the problem linearized there, with the likeliest variance of each group, and the unit of chi-square.
    """

    groups: frozenset[int]
    space: Space
    fit: Fit
    sets: Sets
    state: State

    @property
    def at_bound(self) -> bool:
        """A value stands at a bound: the data ask for something else."""
        lower, upper = self.space.joined("lower"), self.space.joined("upper")
        edge = np.minimum(self.fit.values - lower, upper - self.fit.values)
        return bool(np.any(edge < BOUND * (upper - lower)))

    @property
    def covariance(self) -> Array:
        """Covariance (K, K) of its values, in the units of the parameters."""
        typical = self.space.joined("typical")
        return self.sets.fitted(self.state).covariance * np.outer(typical, typical)

    def score_at(self, unit: float) -> float:
        """Log probability with a given unit of chi-square, a constant left out."""
        return self.sets.score_at(self.state, unit)


class OwnMinima:
    """The sets of one problem.

    Attributes
    ----------
    whole : all candidates; members : numbers of those of each group.
    visited : every set that was looked at.
    """

    def __init__(self, problem: Problem, say: Say) -> None:
        self.problem, self.say = problem, say
        self.whole = Space(problem.pool())
        self.members, self.groups = grouped(self.whole, ())
        nothing = Space(())
        self.noise = noise_of(problem, problem.sums(nothing, np.zeros(0), derivatives=False))
        self.visited: dict[frozenset[int], Visited] = {}
        self._beside: dict[frozenset[int], tuple[Sets, State]] = {}

    def run(self) -> Visited:
        """The likeliest set; what could stand in each place of it has been visited."""
        best, seen = self._climbed(self.at(frozenset())), set[frozenset[int]]()
        while best.groups not in seen:
            seen.add(best.groups)
            others = [v for g in best.groups for v in self.in_place_of(g, best).values() if not v.at_bound]
            other = likelier(best, others)
            best = best if other is best else self._climbed(other)
        return best

    def candidates_of(self, group: int) -> list[Candidate]:
        """The candidates of one group."""
        return [self.whole.candidates[m] for m in self.members[group]]

    def at(self, groups: frozenset[int], near: Visited | None = None) -> Visited:
        """A set at its own minimum; the fit begins at the values of a set that is near."""
        if groups not in self.visited:
            space = Space(tuple(c for g in sorted(groups) for c in self.candidates_of(g)))
            start, unit = ({}, 1.0) if near is None else (near.space.split(near.fit.values), near.state.unit)
            self.visited[groups] = self._visit(groups, space, self._deepest(space, space.vector(start), unit))
        return self.visited[groups]

    def left(self, here: Visited) -> float:
        """Chi-square that a set leaves beyond noise."""
        return max(here.fit.excess - self.noise.slack, 0.0)

    def _visit(self, groups: frozenset[int], space: Space, fit: Fit) -> Visited:
        part = dict(space.pairs)
        here = [
            Group(np.concatenate([np.r_[part[c]] for c in self.candidates_of(g)]), self.groups[g].share)
            for g in sorted(groups)
        ]
        # At a bound, or where a valley is too flat to follow, slopes are left; nothing can be gained by them.
        least = replace(fit.sums, gradient=np.zeros_like(fit.sums.gradient))
        sets = Sets(quadratic(self.problem, space, fit.values, least), here, self.noise, count=len(self.groups))
        state = State(np.ones(len(here)), self._unit(fit))
        retune(sets, state)
        return Visited(groups, space, fit, sets, state)

    def _unit(self, fit: Fit) -> float:
        """Unit of chi-square: at its own minimum what the data leave is known, whatever the prior takes."""
        return self.noise.unit(fit.excess + (0.0 if self.noise.known else float(fit.sums.freedom.sum())))

    def _deepest(self, space: Space, begin: Array, unit: float) -> Fit:
        least = ENOUGH * unit
        fit = minimize(self.problem, space, begin, least_gain=least)
        if self._unit(fit) < unit:
            # What is left is less than there was, and counts for more.
            least = ENOUGH * self._unit(fit)
            fit = minimize(self.problem, space, fit.values, least_gain=least)
        return fit

    def _climbed(self, here: Visited) -> Visited:
        """Groups added while one is worth it, then what is not needed beside them taken away."""
        while True:
            more = [self.at(here.groups | {g}, here) for g in self._promising(here)]
            worth = [v for v in more if self._worth(v, here)]
            if not worth:
                break
            here = likelier(worth[0], worth)
            self.say(f"{', '.join(c.label for c in here.space.candidates)}: {100 * here.fit.rms:.4g} % left")
        while True:
            less = [self.at(here.groups - {g}, here) for g in here.groups]
            less = [v for v in less if log_odds(here, v) < IMITATES]
            if not less:
                return here
            here = likelier(less[0], less)

    def _worth(self, more: Visited, here: Visited) -> bool:
        """What a group explains is a good part of what is left, far beyond noise, and at values that it may have."""
        enough = self.left(more) <= (1 - EXPLAINS) * self.left(here)
        # Structure that is still left may be another group's.
        unit = 1.0 if self.noise.known else more.state.unit
        return enough and not more.at_bound and more.score_at(unit) - here.score_at(unit) >= IMITATES

    def in_place_of(self, group: int, best: Visited) -> dict[int, Visited]:
        """The set without a group, with each of the groups in its place that may be worth a fit; and with itself."""
        rest = self.at(best.groups - {group}, best)
        return {g: self.at(rest.groups | {g}, rest) for g in {group, *self._promising(rest)}}

    def beside(self, here: Visited) -> tuple[Sets, State]:
        """All groups linearized about the minimum of a set, and that set among them."""
        if here.groups not in self._beside:
            values = self.whole.vector(here.space.split(here.fit.values))
            form = quadratic(self.problem, self.whole, values, self.problem.sums(self.whole, values))
            state = State(np.zeros(len(self.groups)), here.state.unit)
            state.tau[sorted(here.groups)] = here.state.tau
            self._beside[here.groups] = Sets(form, self.groups, self.noise), state
        return self._beside[here.groups]

    def _promising(self, here: Visited) -> list[int]:
        """Groups that may be worth a fit beside a set, the most promising first."""
        sets, state = self.beside(here)
        odds = sets.conditional(state).log_odds
        order = [int(g) for g in np.argsort(-odds) if g not in here.groups and odds[g] > -ALTERNATIVE]
        return order[:LEADERS]

    def posterior(self, here: Visited) -> PosteriorOfMinima:
        """What speaks for each group of a set, with every set that was visited at its own minimum."""
        (sets, state), typical, unit = self.beside(here), self.whole.joined("typical"), here.state.unit
        odds = {g: self._odds(g, here, unit) for g in here.groups}
        visited = list(self.visited.values())
        weight = np.exp([min(v.score_at(unit) - here.score_at(unit), 0.0) for v in visited])
        weight /= weight.sum()
        there = np.array([[g in v.groups for g in range(len(self.groups))] for v in visited])
        part = dict(self.whole.pairs)
        index = np.concatenate([np.zeros(0, dtype=int), *(np.r_[part[c]] for c in here.space.candidates)])
        values, covariance = np.zeros(typical.size), np.zeros((typical.size, typical.size))
        values[index] = here.fit.values
        covariance[np.ix_(index, index)] = here.covariance
        return PosteriorOfMinima(
            space=self.whole,
            members=self.members,
            sets=sets,
            samples=Samples(
                weight @ there, values / typical, covariance / np.outer(typical, typical), there, weight, state
            ),
            values=values,
            covariance=covariance,
            others={},
            odds=odds,
        )

    def _odds(self, group: int, here: Visited, unit: float) -> Array:
        """Log odds (G,) of a group of a set, and of each that was tried in its place, of being there."""
        out = np.full(len(self.groups), -np.inf)
        without = self.at(here.groups - {group}, here).score_at(unit)
        for g, v in self.in_place_of(group, here).items():
            out[g] = v.score_at(unit) - without
        return out


@dataclass(frozen=True)
class PosteriorOfMinima(Posterior):
    """The posterior where every set has a minimum of its own; values and covariance are those of one set.

    `odds` : by a group of it, log odds (G,) of every group in its place, each at its own minimum.
    """

    odds: Mapping[int, Array]

    def in_place_of(self, group: int) -> Array:
        return self.odds[group]

    def of_likeliest(self) -> tuple[Array, Array]:
        return self.values, self.covariance


def log_odds(one: Visited, other: Visited) -> float:
    """Log odds of a set against another one, in the unit of chi-square of what explains more."""
    unit = min(one.state.unit, other.state.unit)
    return one.score_at(unit) - other.score_at(unit)


def likelier(best: Visited, others: Iterable[Visited]) -> Visited:
    """The likeliest of some sets."""
    for other in others:
        best = other if log_odds(other, best) > 0 else best
    return best
