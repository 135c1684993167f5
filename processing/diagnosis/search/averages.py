"""Averages over sets of groups, each weighted by its probability.

Where the noise is unknown, and in the rounds before the last: weighted tempered Gibbs sampling (Zanella and Roberts,
J. R. Stat. Soc. B 81, 489, 2019). The chain only finds the sets; each counts once, by its evidence. Where the noise
is known: a Gibbs chain in continuous time (Bortz, Kalos and Lebowitz, J. Comput. Phys. 17, 10, 1975), in which a set
counts by how long the chain stays there. That includes the many sets that are unlikely one by one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.likely_set import climb
from processing.diagnosis.search.rules import ALTERNATIVE, CERTAIN, SHARES
from processing.diagnosis.search.sets import Conditional, Group, Quadratic, Sets, State, probability_at

#: [probability] Weight of a set below which it changes no mean.
LEAST_WEIGHT = 1e-6
#: [of its probability] Least rate at which a group is tested, relative to a group with probability 1/2.
LEAST_INTEREST = 0.04
#: [groups] Alternatives that are tried for one group.
MOST_RIVALS = 8


@dataclass(frozen=True)
class Samples:
    """Weighted average over the sets that were visited.

    Attributes
    ----------
    probability : (G,) of each group to be there; mean (K,), covariance (K, K) of the parameters in typical sizes.
    sets : (S, G) which groups were there; weight : (S,), sum 1.
    best : the most likely set.
    """

    probability: Array
    mean: Array
    covariance: Array
    sets: NDArray[np.bool_]
    weight: Array
    best: State

    def any_of(self, members: Sequence[int]) -> float:
        """Probability that at least one of some groups is there."""
        return float(self.weight @ self.sets[:, list(members)].any(axis=1))


def _moments(sets: Sets, visited: Iterable[tuple[float, Conditional, Array]]) -> tuple[Array, Array, Array]:
    """Probability (G,) of each group; mean (K,) and covariance (K, K) of the parameters, of weighted sets."""
    probability, mean, second = np.zeros(len(sets.groups)), np.zeros(sets.size), np.zeros((sets.size, sets.size))
    for weight, c, chance in visited:
        probability += weight * chance
        if weight > LEAST_WEIGHT:
            mean[c.active] += weight * c.mean
            second[np.ix_(c.active, c.active)] += weight * (c.covariance + np.outer(c.mean, c.mean))
    return probability, mean, second - np.outer(mean, mean)


class _ByEvidence:
    """Every set that was visited counts once, by how likely it is."""

    def __init__(self, sets: Sets) -> None:
        self._sets = sets
        self._seen: dict[bytes, tuple[float, Conditional, State, Array]] = {}

    def add(self, c: Conditional, state: State, chance: Array) -> None:
        key = (state.tau > 0).tobytes()
        if key not in self._seen or c.score > self._seen[key][0]:
            self._seen[key] = (c.score, c, state.copy(), chance)

    @property
    def best(self) -> State:
        """The likeliest set so far."""
        return max(self._seen.values(), key=lambda v: v[0])[2]

    def samples(self) -> Samples:
        visits = sorted(self._seen.values(), key=lambda v: -v[0])
        weight = np.exp(np.array([v[0] for v in visits]) - visits[0][0])
        weight /= weight.sum()
        average = _moments(self._sets, ((w, c, chance) for w, (_, c, _, chance) in zip(weight, visits, strict=True)))
        inclusion = np.array([v[2].tau > 0 for v in visits])
        return Samples(*average, inclusion, weight, visits[0][2])


def sample(sets: Sets, state: State, visits: int, seed: int = 0) -> Samples:
    """Average over sets, from a likely one on; the unit of chi-square stays that of the first."""
    random = np.random.default_rng(seed)
    state, average = state.copy(), _ByEvidence(sets)
    interest = np.full(len(sets.groups), LEAST_INTEREST / 2)
    for _ in range(visits):
        c = sets.conditional(state)
        present = state.tau > 0
        chance = chance_of(sets, c)
        average.add(c, state, chance)
        now = np.where(present, chance, 1 - chance)
        rate = np.where(sets.free, interest / np.maximum(now, 1e-12), 0.0)
        if not rate.any():
            break
        interest = np.maximum(interest, np.minimum(chance, 0.5) * sets.free)
        k = int(random.choice(rate.size, p=rate / rate.sum()))
        is_included = random.random() < 0.5
        state.tau[k] = sets.taus[int(random.choice(sets.taus.size, p=c.tau_weights[k]))] if is_included else 0.0
    # Where what is left is the noise, a set that leaves less has a smaller unit, and must be passed to step by step.
    for alternative in swap_groups(sets, average.best) if sets.noise.is_known else ():
        c = sets.conditional(alternative)
        average.add(c, alternative, chance_of(sets, c))
    return average.samples()


def chance_of(sets: Sets, c: Conditional) -> Array:
    """Probability (G,) of each group given the others."""
    return np.where(sets.free, probability_at(c.log_odds), 1.0)


def swap_groups(sets: Sets, state: State) -> Iterator[State]:
    """The set with each of its groups in turn replaced by an alternative that fits nearly as well.

    Of two equivalent groups the chain may never visit the second: its way leads through a set with both or neither.
    """
    for k in np.flatnonzero((state.tau > 0) & sets.free):
        without = sets.without(state, int(k))
        c = sets.conditional(without)
        rivals = np.flatnonzero(sets.free & (state.tau == 0) & (c.log_odds > c.log_odds[k] - ALTERNATIVE))
        for j in rivals[np.argsort(-c.log_odds[rivals])][:MOST_RIVALS]:
            alternative = without.copy()
            alternative.tau[j] = sets.taus[int(np.argmax(c.tau_weights[j]))]
            yield alternative


class ReducedSets:
    """Sets in addition to the certain groups of a likely state, whose variances and unit of chi-square are fixed.

    Attributes
    ----------
    sets : of the groups `plausible` (R,), numbers among all; `certain` (C,) are always there.
    start : the likely state in them.
    """

    def __init__(self, full: Sets, state: State) -> None:
        self._whole, self._state = full, state
        certain, odds = _worth(full, state)
        plausible = (full.share == 1) | (odds > np.log(SHARES / (1 - SHARES)))
        if (certain & full.alone).any():
            plausible &= ~full.alone
        self.certain, self.plausible = np.flatnonzero(certain), np.flatnonzero(plausible & ~certain)
        self._out, self._in = _positions(full, self.certain), _positions(full, self.plausible)
        unit, form = state.unit, full.form
        prior = [np.full(full.groups[k].index.size, state.tau[k] ** -2.0) for k in self.certain]
        block = form.curvature[np.ix_(self._out, self._out)] / unit + np.diag(np.concatenate([np.zeros(0), *prior]))
        self._covariance = np.linalg.inv(block)
        cross = form.curvature[np.ix_(self._out, self._in)]
        # What is projected out has the mean self._mean + self._turn @ x of all others.
        self._mean = -self._covariance @ form.gradient[self._out] / unit
        self._turn = -self._covariance @ cross / unit
        curvature = form.curvature[np.ix_(self._in, self._in)] + cross.T @ self._turn
        reduced_form = Quadratic(
            float(form.excess + form.gradient[self._out] @ self._mean),
            form.gradient[self._in] + cross.T @ self._mean,
            (curvature + curvature.T) / 2,
        )
        certain_count = int(np.sum(full.free[self.certain]))
        self.sets = full.among(reduced_form, self.plausible, _renumber(full, self.plausible), certain_count)
        self.start = State(state.tau[self.plausible].copy(), unit)

    def lift(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Mean (K,) and covariance (K, K) of all parameters, of those of the groups that are kept."""
        size = self._whole.size
        full, spread = np.zeros(size), np.zeros((size, size))
        full[self._in], full[self._out] = mean, self._mean + self._turn @ mean
        turned = self._turn @ covariance
        spread[np.ix_(self._in, self._in)] = covariance
        spread[np.ix_(self._out, self._in)], spread[np.ix_(self._in, self._out)] = turned, turned.T
        spread[np.ix_(self._out, self._out)] = self._covariance + turned @ self._turn.T
        return full, spread

    def whole_state(self, state: State) -> State:
        """A state of all groups, of one of those that are kept."""
        tau = np.zeros(self._state.tau.size)
        tau[self.certain], tau[self.plausible] = self._state.tau[self.certain], state.tau
        return State(tau, state.unit)


def _worth(sets: Sets, state: State) -> tuple[NDArray[np.bool_], Array]:
    """Groups (G,) that are certain, and the log odds (G,) of each in addition to the others or instead of one."""
    is_included = state.tau > 0
    certain = is_included & ~sets.free
    reach = sets.conditional(state).log_odds
    for k in np.flatnonzero(is_included & sets.free):
        odds = sets.conditional(sets.without(state, int(k))).log_odds
        instead = np.where(is_included, -np.inf, odds) - max(odds[k], 0.0)
        reach = np.maximum(reach, instead)
        large = bool(sets.many[k])
        certain[k] = large and odds[k] > CERTAIN and instead.max(initial=-np.inf) < -CERTAIN
    return certain, np.where(is_included, np.inf, reach)


def _positions(sets: Sets, groups: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate([np.zeros(0, dtype=np.int64), *(sets.groups[k].index for k in groups)])


def _renumber(sets: Sets, groups: NDArray[np.int64]) -> list[Group]:
    renumbered, first = [], 0
    for k in groups:
        size = sets.groups[k].index.size
        renumbered.append(replace(sets.groups[k], index=np.arange(first, first + size)))
        first += size
    return renumbered


class _ByStay:
    """Every state that was visited counts by how long the chains stay there."""

    def __init__(self, sets: Sets) -> None:
        self._sets = sets
        self._known: dict[bytes, tuple[Conditional, Array]] = {}
        self._seen: dict[bytes, float] = {}
        self.best: tuple[float, State] | None = None

    def conditional(self, state: State) -> tuple[Conditional, Array]:
        """Conditional posterior of every group given the others, and the probability (G,) of each."""
        key = state.tau.tobytes()
        if key not in self._known:
            c = self._sets.conditional(state)
            self._known[key] = c, chance_of(self._sets, c)
            if self.best is None or c.score > self.best[0]:
                self.best = c.score, state.copy()
        return self._known[key]

    def visit(self, start: State, share: float, changes: int, random: np.random.Generator) -> None:
        """A chain from one state on, which counts `share` as a whole."""
        sets, state = self._sets, start.copy()
        stays: dict[bytes, float] = {}
        for _ in range(changes):
            c, chance = self.conditional(state)
            rate = np.column_stack([1 - chance, chance[:, None] * c.tau_weights])
            at = np.argmin(np.abs(np.append(0.0, sets.taus)[:, None] - state.tau), axis=0)
            rate[np.arange(at.size), at] = 0.0
            rate[~sets.free] = 0.0
            key, total = state.tau.tobytes(), float(rate.sum())
            stays[key] = stays.get(key, 0.0) + 1 / max(total, 1e-12)
            if total <= 0:
                break
            k, width = divmod(int(random.choice(rate.size, p=rate.ravel() / total)), rate.shape[1])
            state.tau[k] = sets.taus[width - 1] if width else 0.0
        for key, stay in stays.items():
            self._seen[key] = self._seen.get(key, 0.0) + share * stay / sum(stays.values())

    def moments(self) -> tuple[Array, Array, Array]:
        """Probability (G,) of each group; mean (K,) and covariance (K, K) of the parameters."""
        total = sum(self._seen.values())
        return _moments(self._sets, ((weight / total, *self._known[key]) for key, weight in self._seen.items()))

    def inclusion(self) -> tuple[NDArray[np.bool_], Array]:
        """Groups (S, G) of each set, and the weight (S,) of the set."""
        weight: dict[bytes, float] = {}
        for key, share in self._seen.items():
            inclusion = (np.frombuffer(key) > 0).tobytes()
            weight[inclusion] = weight.get(inclusion, 0.0) + share
        sets = np.array([np.frombuffer(key, dtype=bool) for key in weight]).reshape(len(weight), -1)
        return sets, np.array(list(weight.values())) / sum(weight.values())


def stay(sets: Sets, state: State, changes: int, seed: int = 0) -> Samples:
    """Average over sets, from a likely one on; the unit of chi-square stays that of the first."""
    random, reduced = np.random.default_rng(seed), ReducedSets(sets, state)
    average = _ByStay(reduced.sets)
    for start, share in _starts(reduced.sets, reduced.start):
        average.visit(start, share, max(1, round(changes * share)), random)
    probability = chance_of(sets, sets.conditional(state))
    chance, mean, covariance = average.moments()
    probability[reduced.plausible] = chance
    inside, weight = average.inclusion()
    inclusion = np.zeros((len(weight), len(sets.groups)), dtype=bool)
    inclusion[:, reduced.certain] = True
    inclusion[:, reduced.plausible] = inside
    best = reduced.whole_state(average.best[1] if average.best else reduced.start)
    return Samples(probability, *reduced.lift(mean, covariance), inclusion, weight, best)


def _starts(sets: Sets, state: State) -> list[tuple[State, float]]:
    """Start states, each with its share of the changes: the likely one, and those that are equally likely.

    Of two equivalent groups the chain may never visit the second: its way leads through a set with both or neither.
    A group that replaces several would need all of them to leave at once.
    """
    indices = np.flatnonzero((state.tau > 0) & sets.free)
    instead = (climb(sets, sets.without(state, int(k)), without=int(k)) for k in indices)
    several = (State(s.tau, state.unit) for s in instead)
    states = {s.tau.tobytes(): s for s in (state, *swap_groups(sets, state), *several)}.values()
    score = np.array([sets.score(s) for s in states])
    share = np.exp(score - score.max())
    share /= share.sum()
    starts = [(s, float(w)) for s, w in zip(states, share, strict=True) if w > SHARES]
    total = sum(w for _, w in starts)
    return [(s, w / total) for s, w in starts]
