"""Visit sets of groups and average over them, each weighted by its probability.

Weighted tempered Gibbs sampling (Zanella and Roberts, J. R. Stat. Soc. B 81, 489, 2019): a group whose present state is
unlikely given the others is the more likely to be asked next, so that of two groups that explain the same now one is
there and now the other. The chain only finds the sets: what they weigh is known, so each counts once, by its evidence.
That leaves out the many sets that are unlikely one by one (`stays.py` has them).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.odds import probability_at
from processing.diagnosis.search.rules import ALTERNATIVE
from processing.diagnosis.search.sets import Conditional, Sets, State

#: [probability] Weight of a set below which it changes no mean.
LEAST_WEIGHT = 1e-6
#: [of its probability] How often a group is asked at least, relative to one that is there half of the time.
LEAST_INTEREST = 0.04
#: [groups] That are tried in the place of one.
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


class _Average:
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
        seen = sorted(self._seen.values(), key=lambda v: -v[0])
        weight = np.exp(np.array([v[0] for v in seen]) - seen[0][0])
        weight /= weight.sum()
        probability = np.zeros(len(self._sets.groups))
        size = self._sets.size
        mean, second = np.zeros(size), np.zeros((size, size))
        for w, (_, c, _, chance) in zip(weight, seen, strict=True):
            if w < LEAST_WEIGHT:
                break
            probability += w * chance
            mean[c.active] += w * c.mean
            second[np.ix_(c.active, c.active)] += w * (c.covariance + np.outer(c.mean, c.mean))
        there = np.array([v[2].tau > 0 for v in seen])
        return Samples(probability, mean, second - np.outer(mean, mean), there, weight, seen[0][2])


def sample(sets: Sets, state: State, visits: int, seed: int = 0) -> Samples:
    """Average over sets, from a likely one on; the unit of chi-square stays that of the first."""
    random = np.random.default_rng(seed)
    state, average = state.copy(), _Average(sets)
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
        there = random.random() < 0.5
        state.tau[k] = sets.taus[int(random.choice(sets.taus.size, p=c.tau_weights[k]))] if there else 0.0
    # Where what is left is the noise, a set that leaves less has a smaller unit, and must be passed to step by step.
    for other in swapped(sets, average.best) if sets.noise.known else ():
        c = sets.conditional(other)
        average.add(c, other, chance_of(sets, c))
    return average.samples()


def chance_of(sets: Sets, c: Conditional) -> Array:
    """Probability (G,) of each group given the others."""
    return np.where(sets.free, probability_at(c.log_odds), 1.0)


def swapped(sets: Sets, state: State) -> Iterator[State]:
    """The set with one of its groups in turn exchanged for one that would do nearly as well in its place.

    Of two that say the same the chain may never see the second: it would have to pass a set with both or with none.
    """
    for k in np.flatnonzero((state.tau > 0) & sets.free):
        without = sets.without(state, int(k))
        c = sets.conditional(without)
        rivals = np.flatnonzero(sets.free & (state.tau == 0) & (c.log_odds > c.log_odds[k] - ALTERNATIVE))
        for j in rivals[np.argsort(-c.log_odds[rivals])][:MOST_RIVALS]:
            other = without.copy()
            other.tau[j] = sets.taus[int(np.argmax(c.tau_weights[j]))]
            yield other
