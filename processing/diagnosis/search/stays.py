"""Average over sets of groups by how long a chain stays in each.

A Gibbs chain in continuous time (Bortz, Kalos and Lebowitz, J. Comput. Phys. 17, 10, 1975): every change of one group,
to be absent or of another variance, happens at the rate of its probability given the others. Of the many sets that are
unlikely one by one and not together it sees as many as there are; most of the error of M is in them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.reduced_sets import ReducedSets
from processing.diagnosis.search.rules import SHARES
from processing.diagnosis.search.sampling import LEAST_WEIGHT, Samples, chance_of, swapped
from processing.diagnosis.search.sets import Conditional, Sets, State


class _Average:
    """Every state that was visited counts by how long the chains stay there."""

    def __init__(self, sets: Sets) -> None:
        self._sets = sets
        self._known: dict[bytes, tuple[Conditional, Array]] = {}
        self._seen: dict[bytes, float] = {}
        self.best: tuple[float, State] | None = None

    def asked(self, state: State) -> tuple[Conditional, Array]:
        """What a state says of every group given the others, and the probability (G,) of each."""
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
            c, chance = self.asked(state)
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
        probability, size = np.zeros(len(self._sets.groups)), self._sets.size
        mean, second = np.zeros(size), np.zeros((size, size))
        for key, weight in self._seen.items():
            c, chance = self._known[key]
            share = weight / total
            probability += share * chance
            if share > LEAST_WEIGHT:
                mean[c.active] += share * c.mean
                second[np.ix_(c.active, c.active)] += share * (c.covariance + np.outer(c.mean, c.mean))
        return probability, mean, second - np.outer(mean, mean)

    def there(self) -> tuple[NDArray[np.bool_], Array]:
        """Which groups (S, G) were there in each set, and how much it weighs (S,)."""
        weight: dict[bytes, float] = {}
        for key, share in self._seen.items():
            there = (np.frombuffer(key) > 0).tobytes()
            weight[there] = weight.get(there, 0.0) + share
        sets = np.array([np.frombuffer(key, dtype=bool) for key in weight]).reshape(len(weight), -1)
        return sets, np.array(list(weight.values())) / sum(weight.values())


def stay(sets: Sets, state: State, changes: int, seed: int = 0) -> Samples:
    """Average over sets, from a likely one on; the unit of chi-square stays that of the first."""
    random, reduced = np.random.default_rng(seed), ReducedSets(sets, state)
    average = _Average(reduced.sets)
    for start, share in _starts(reduced.sets, reduced.start):
        average.visit(start, share, max(1, round(changes * share)), random)
    probability = chance_of(sets, sets.conditional(state))
    chance, mean, covariance = average.moments()
    probability[reduced.kept] = chance
    inside, weight = average.there()
    there = np.zeros((len(weight), len(sets.groups)), dtype=bool)
    there[:, reduced.certain] = True
    there[:, reduced.kept] = inside
    best = reduced.whole_state(average.best[1] if average.best else reduced.start)
    return Samples(probability, *reduced.lifted(mean, covariance), there, weight, best)


def _starts(sets: Sets, state: State) -> list[tuple[State, float]]:
    """States to start from, and what share of the changes each has: the likely one, and those that are as likely.

    Of two groups that say the same the chain may never see the second: it would have to pass a set with both or with
    none.
    """
    states = [state, *swapped(sets, state)]
    score = np.array([sets.fitted(s).score for s in states])
    share = np.exp(score - score.max())
    share /= share.sum()
    kept = [(s, float(w)) for s, w in zip(states, share, strict=True) if w > SHARES]
    total = sum(w for _, w in kept)
    return [(s, w / total) for s, w in kept]
