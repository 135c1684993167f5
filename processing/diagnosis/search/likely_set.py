"""A likely set of groups to start from: from nothing upwards, and from everything downwards."""

from __future__ import annotations

import numpy as np

from processing.diagnosis.search.rules import HOPE, NEEDED, PATIENCE, TAU
from processing.diagnosis.search.sets import Sets, State

STEPS = 60


def likely_set(sets: Sets) -> State:
    """The more likely of two: several causes together can be plain where each alone is nothing, and the reverse."""
    up = climb(sets, sets.empty())
    down = climb(sets, thinned(sets))
    return max(up, down, key=lambda s: sets.fitted(s).score)


def climb(sets: Sets, state: State) -> State:
    """The change of one group that gains most, as long as one gains; the unit follows."""
    state = sets.settled(state.copy())
    best, barred = sets.fitted(state).score, np.zeros(len(sets.groups), dtype=bool)
    for _ in range(STEPS):
        c = sets.conditional(state)
        there = state.tau > 0
        gain = np.where(sets.free & ~barred, np.where(there, -c.log_odds, c.log_odds), -np.inf)
        k = int(np.argmax(gain))
        if gain[k] < HOPE or barred.sum() > PATIENCE:
            break
        tried = state.copy()
        tried.tau[k] = 0.0 if there[k] else TAU[int(np.argmax(c.tau_weights[k]))]
        now = sets.fitted(sets.settled(tried)).score
        if now > best:
            state, best = tried, now
            barred[:] = False
            retune(sets, state)
        else:
            barred[k] = True
    return sets.settled(state)


def thinned(sets: Sets) -> State:
    """From every group at its typical size, the least needed taken away until all are needed; the likeliest of these.

    Alternatives of which one may be there are too many to begin with.
    """
    base = sets.empty()
    state = sets.settled(State(np.where(sets.free & (sets.share == 1), 1.0, base.tau)))
    best, kept = -np.inf, state.copy()
    while True:
        c = sets.conditional(state)
        if c.score > best:
            best, kept = c.score, state.copy()
        odds = np.where((state.tau > 0) & sets.free, c.log_odds, np.inf)
        if odds.min(initial=np.inf) > NEEDED:
            return kept
        worst = np.argsort(odds)[: max(1, int(np.sum(odds < 0)) // 6)]
        state.tau[worst] = 0.0
        retune(sets, state)
        sets.settled(state)


def retune(sets: Sets, state: State) -> None:
    """Every group at its likeliest variance."""
    c = sets.conditional(state)
    there = (state.tau > 0) & sets.free
    state.tau[there] = TAU[np.argmax(c.tau_weights[there], axis=1)]
