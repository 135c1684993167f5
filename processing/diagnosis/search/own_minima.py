"""Sets of groups where the model is far from linear: every set is linearized about its own minimum.

The evidence of a set is then that of its own fit (Laplace's approximation), and no set is judged by the slopes of
another one. Each costs a fit, so sets are few: from nothing, the change of one group that gains most, as long as one
gains; then every group of the likeliest set is exchanged for every other that promises as much.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause, least_odds
from processing.diagnosis.search.fit import Fit, minimize
from processing.diagnosis.search.likely_set import retune
from processing.diagnosis.search.linearized import grouped, noise_of, quadratic
from processing.diagnosis.search.posterior import Say
from processing.diagnosis.search.problem import Problem
from processing.diagnosis.search.rules import BOUND, EXPLAINS, HOPE, IMITATES, LEADERS
from processing.diagnosis.search.sets import Group, Sets, State
from processing.diagnosis.search.space import Space

#: A fit of a set ends when a step gains less than this, in the unit of chi-square.
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

    def score_at(self, unit: float) -> float:
        """Log probability with a given unit of chi-square, a constant left out."""
        return self.sets.score_at(self.state, unit)


class OwnMinima:
    """The sets of one problem.

    Attributes
    ----------
    members : candidates of each group.
    visited : every set that was looked at.
    """

    def __init__(self, problem: Problem, say: Say) -> None:
        self.problem, self.say = problem, say
        self.whole = Space(problem.pool())
        members, self.groups = grouped(self.whole, ())
        self.members = [[self.whole.candidates[k] for k in mine] for mine in members]
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

    def at(self, groups: frozenset[int], near: Visited | None = None) -> Visited:
        """A set at its own minimum; the fit begins at the values of a set that is near."""
        if groups not in self.visited:
            space = Space(tuple(c for g in sorted(groups) for c in self.members[g]))
            start, unit = ({}, 1.0) if near is None else (values_of(near), near.state.unit)
            begin = np.concatenate([np.zeros(0), *(start.get(c, np.zeros(c.size)) for c in space.candidates)])
            self.visited[groups] = self._visit(groups, space, self._deepest(space, begin, unit))
        return self.visited[groups]

    def left(self, here: Visited) -> float:
        """Chi-square that a set leaves beyond noise."""
        return max(here.fit.excess - self.noise.slack, 0.0)

    def _visit(self, groups: frozenset[int], space: Space, fit: Fit) -> Visited:
        part = dict(zip(space.candidates, space.slices, strict=True))
        here = [
            Group(np.concatenate([np.r_[part[c]] for c in self.members[g]]), self.groups[g].share)
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
        for candidate, part in zip(space.candidates, space.slices, strict=True):
            for far in candidate.starts:
                start = fit.values.copy()
                start[part] = far
                tried = minimize(self.problem, space, start, least_gain=least)
                fit = tried if tried.excess < fit.excess - least else fit
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
            known = values_of(here)
            values = np.concatenate([known.get(c, np.zeros(c.size)) for c in self.whole.candidates])
            form = quadratic(self.problem, self.whole, values, self.problem.sums(self.whole, values))
            state = State(np.zeros(len(self.groups)), here.state.unit)
            state.tau[sorted(here.groups)] = here.state.tau
            self._beside[here.groups] = Sets(form, self.groups, self.noise), state
        return self._beside[here.groups]

    def _promising(self, here: Visited) -> list[int]:
        """Groups that may be worth a fit beside a set, the most promising first."""
        sets, state = self.beside(here)
        odds = sets.conditional(state).log_odds
        order = [int(g) for g in np.argsort(-odds) if g not in here.groups and odds[g] > HOPE]
        return order[:LEADERS]

    def causes(self, best: Visited, left: float) -> dict[int, Cause]:
        """The groups of a set as causes, by number; `left` is the chi-square that nothing explains."""
        unit = best.state.unit
        odds = {g: self._odds(g, best, unit) for g in best.groups}
        likely = np.exp([min(v.score_at(unit) - best.score_at(unit), 0.0) for v in self.visited.values()])
        likely /= likely.sum()
        fitted, typical = best.sets.fitted(best.state), best.space.joined("typical")
        part = dict(zip(best.space.candidates, best.space.slices, strict=True))
        out = {}
        for g, mine in odds.items():
            least = least_odds(mine[g], left / unit)
            others = sorted((j for j in mine if j != g and mine[j] > least), key=lambda j: -mine[j])
            seen = [not v.groups.isdisjoint({g, *others}) for v in self.visited.values()]
            total = float(np.logaddexp.reduce([mine[j] for j in (g, *others)]))
            out[g] = Cause(
                candidates=tuple(self.members[g]),
                values=tuple(best.fit.values[part[c]] for c in self.members[g]),
                covariance=tuple(
                    fitted.covariance[part[c], part[c]] * np.outer(typical[part[c]], typical[part[c]])
                    for c in self.members[g]
                ),
                probability=min(float(likely @ seen), float(1 / (1 + np.exp(-np.clip(total, -50, 50))))),
                log_odds=mine[g],
                alternatives=tuple(self.members[j][0] for j in others),
            )
        return out

    def _odds(self, group: int, best: Visited, unit: float) -> dict[int, float]:
        """Log odds of a group, and of others in its place, of being there."""
        without = self.at(best.groups - {group}, best).score_at(unit)
        return {g: v.score_at(unit) - without for g, v in self.in_place_of(group, best).items()}


def log_odds(one: Visited, other: Visited) -> float:
    """Log odds of a set against another one, in the unit of chi-square of what explains more."""
    unit = min(one.state.unit, other.state.unit)
    return one.score_at(unit) - other.score_at(unit)


def likelier(best: Visited, others: Iterable[Visited]) -> Visited:
    """The likeliest of some sets."""
    for other in others:
        best = other if log_odds(other, best) > 0 else best
    return best


def values_of(here: Visited) -> dict[Candidate, Array]:
    """Values at the minimum by candidate."""
    return {c: here.fit.values[p] for c, p in zip(here.space.candidates, here.space.slices, strict=True)}
