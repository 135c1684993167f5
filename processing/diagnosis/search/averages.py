"""Averages over sets of groups, each weighted by its probability.

A Gibbs chain in continuous time (Bortz, Kalos and Lebowitz, J. Comput. Phys. 17, 10, 1975), in which a set counts by
how long the chain stays there. That includes the many sets that are unlikely one by one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from processing.arrays import Array
from processing.diagnosis.search.likely_set import PATIENCE, climb
from processing.diagnosis.search.range_of import NEARLY_ZERO
from processing.diagnosis.search.rules import ALTERNATIVE, SURE, TAKES_PART
from processing.diagnosis.search.sets import Conditional, SetFit, Sets, State


@dataclass(frozen=True)
class Samples:
    """Weighted average over the sets that were visited.

    Attributes
    ----------
    probability : (G,) of each group to be there; mean (K,), covariance (K, K) of the parameters in typical sizes.
    supported : (G,) of each group to be there with a Bayes factor above one, or, of one that is always there, with one
        that makes it sure; any_supported : of one at least that may be absent.
    sets : (S, G) which groups were there; weight : (S,), sum 1.
    fits : the sets with a share that counts, each with that share (sum 1).
    best : the most likely set.
    """

    probability: Array
    supported: Array
    any_supported: float
    mean: Array
    covariance: Array
    sets: NDArray[np.bool_]
    weight: Array
    fits: tuple[tuple[float, SetFit], ...]
    best: State

    @property
    def takes_part(self) -> NDArray[np.bool_]:
        """Groups (G,) that are fitted and corrected: likely enough, and mostly supported where they are there."""
        return (self.probability > TAKES_PART) & (self.supported > self.probability / 2)

    def any_of(self, members: Sequence[int]) -> float:
        """Probability that at least one of some groups is there."""
        return float(self.weight @ self.sets[:, list(members)].any(axis=1))

    def along(self, direction: Array) -> tuple[Array, Array, Array]:
        """Share (S,), mean (S,) and standard deviation (S,) of a sum of parameters with weights (K,), in each set."""
        rows = [
            (share, direction[fit.active] @ fit.mean, direction[fit.active] @ fit.covariance @ direction[fit.active])
            for share, fit in self.fits
        ]
        share, mean, variance = np.array(rows).T
        return share, mean, np.sqrt(np.maximum(variance, 0.0))


def chance_of(sets: Sets, c: Conditional, state: State) -> Array:
    """Probability (G,) of each group given the others."""
    return np.where(sets.free, expit(sets.learnt_odds(c, state.tau > 0)), 1.0)


def swap_groups(sets: Sets, state: State) -> Iterator[State]:
    """The set with each of its groups in turn replaced by an alternative that fits nearly as well.

    Of two equivalent groups the chain may never visit the second: its way leads through a set with both or neither.
    """
    for k in np.flatnonzero((state.tau > 0) & sets.free):
        without = sets.without(state, int(k))
        c = sets.conditional(without)
        rivals = np.flatnonzero(sets.free & (state.tau == 0) & (c.log_odds > c.log_odds[k] - ALTERNATIVE))
        for j in rivals[np.argsort(-c.log_odds[rivals])][:PATIENCE]:
            alternative = without.copy()
            alternative.tau[j] = sets.taus[int(np.argmax(c.tau_weights[j]))]
            yield alternative


def _key(state: State) -> bytes:
    return np.append(state.unit, state.tau).tobytes()


class _ByStay:
    """Every state that was visited counts by how long the chains stay there."""

    def __init__(self, sets: Sets) -> None:
        self._sets = sets
        self._known: dict[bytes, tuple[Conditional, Array]] = {}
        self._seen: dict[bytes, float] = {}
        self.best: tuple[float, State] | None = None

    def conditional(self, state: State) -> tuple[Conditional, Array]:
        """Conditional posterior of every group given the others, and the probability (G,) of each."""
        key = _key(state)
        if key not in self._known:
            c = self._sets.conditional(state)
            self._known[key] = c, chance_of(self._sets, c, state)
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
            rate[~sets.is_learnt], rate[~sets.free, 0] = 0.0, 0.0
            key, total = _key(state), float(rate.sum())
            stays[key] = stays.get(key, 0.0) + 1 / max(total, 1e-12)
            if total <= 0:
                break
            k, width = divmod(int(random.choice(rate.size, p=rate.ravel() / total)), rate.shape[1])
            state.tau[k] = sets.taus[width - 1] if width else 0.0
            self._change_unit(state, random)
        for key, stay in stays.items():
            self._seen[key] = self._seen.get(key, 0.0) + share * stay / sum(stays.values())

    def _change_unit(self, state: State, random: np.random.Generator) -> None:
        """A Metropolis step of the unit where the noise is not known: what explains much makes it smaller."""
        if self._sets.noise.is_known:
            return
        spread = np.sqrt(2 / self._sets.noise.directions)
        new = State(state.tau, state.unit * float(np.exp(spread * random.normal())))
        if new.unit < self._sets.noise.floor:
            return
        if np.log(random.random()) < self._sets.score(new) - self._sets.score(state):
            state.unit = new.unit

    def fits(self) -> tuple[tuple[float, SetFit], ...]:
        """The sets with a share that counts, each with that share."""
        likely = {key: stays for key, stays in self._seen.items() if stays > NEARLY_ZERO * sum(self._seen.values())}
        return tuple((stays / sum(likely.values()), self._known[key][0]) for key, stays in likely.items())

    def moments(self) -> tuple[Array, Array, float, Array, Array]:
        """Probability (G,) of each group, with support, and of any; mean (K,), covariance (K, K) of values."""
        sets, total = self._sets, sum(self._seen.values())
        (probability, supported), of_any = np.zeros((2, len(sets.groups))), 0.0
        # Values of a group that is always there may be noise. The next round is linearized about what is supported, and
        # about noise an offset seems evident: the more light it leaves, the smaller the levels of the source can be.
        least = np.where(sets.free, 0.0, logit(SURE))
        mean, second = np.zeros(sets.size), np.zeros((sets.size, sets.size))
        for key, stays in self._seen.items():
            (c, chance), weight = self._known[key], stays / total
            probability += weight * chance
            supported += weight * chance * (c.log_factor > least)
            of_any += weight * bool(np.any(sets.free & (c.log_factor > 0) & (np.frombuffer(key)[1:] > 0)))
            if weight > NEARLY_ZERO:
                mean[c.active] += weight * c.mean
                second[np.ix_(c.active, c.active)] += weight * (c.covariance + np.outer(c.mean, c.mean))
        return probability, supported, of_any, mean, second - np.outer(mean, mean)

    def inclusion(self) -> tuple[NDArray[np.bool_], Array]:
        """Groups (S, G) of each set, and the weight (S,) of the set."""
        weight: dict[bytes, float] = {}
        for key, share in self._seen.items():
            inclusion = (np.frombuffer(key)[1:] > 0).tobytes()
            weight[inclusion] = weight.get(inclusion, 0.0) + share
        sets = np.array([np.frombuffer(key, dtype=bool) for key in weight]).reshape(len(weight), -1)
        return sets, np.array(list(weight.values())) / sum(weight.values())


def stay(sets: Sets, starts: Iterable[tuple[State, float]], changes: int) -> Samples:
    """Average over sets, from likely ones on, each with its share of the changes."""
    random, average = np.random.default_rng(0), _ByStay(sets)
    for start, share in starts:
        average.visit(start, share, max(1, round(changes * share)), random)
    assert average.best is not None
    return Samples(*average.moments(), *average.inclusion(), average.fits(), sets.settled(average.best[1]))


def likely_starts(sets: Sets, state: State) -> list[tuple[State, float]]:
    """Start states, each with its share of the changes: the likely one, and those that are equally likely.

    Of two equivalent groups the chain may never visit the second: its way leads through a set with both or neither.
    A group that replaces several would need all of them to leave at once.
    """
    indices = np.flatnonzero((state.tau > 0) & sets.free)
    instead = (climb(sets, sets.without(state, int(k)), without=int(k)) for k in indices)
    several = (State(s.tau, state.unit) for s in instead)
    states = {s.tau.tobytes(): s for s in (state, *swap_groups(sets, state), *several)}.values()
    score = np.array([sets.score(sets.settled(s)) for s in states])
    share = np.exp(score - score.max())
    share /= share.sum()
    starts = [(s, float(w)) for s, w in zip(states, share, strict=True) if w > 1 - SURE]
    total = sum(w for _, w in starts)
    return [(s, w / total) for s, w in starts]
