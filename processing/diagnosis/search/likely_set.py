"""A likely set of groups to start from: from nothing upwards, and from everything downwards."""

from __future__ import annotations

import numpy as np

from processing.diagnosis.search.rules import ALTERNATIVE, NEEDED
from processing.diagnosis.search.sets import NEVER, Conditional, Sets, State

#: [changes] That are tried one after the other without a gain before a climb ends, and instead of one group; one in so
#: many of the groups without evidence is removed at once.
PATIENCE = 8


def likely_set(sets: Sets) -> State:
    """The likelier of two searches: causes can be evident together and not alone, and the reverse."""
    states = [climb(sets, sets.empty()), climb(sets, thin_out(sets))]
    return max(states, key=lambda s: sets.score(s))


def climb(sets: Sets, state: State, without: int | None = None) -> State:
    """The change of one group that gains most, as long as one gains; the unit follows. One group may stay away."""
    state = sets.settled(state.copy())
    away = np.arange(len(sets.groups)) == without
    c = retune(sets, state, follow=True)
    best, barred = sets.score(state), away.copy()
    while True:
        is_included = state.tau > 0
        gain = np.where(sets.free & ~barred, np.where(is_included, -c.log_odds, c.log_odds), -np.inf)
        k = int(np.argmax(gain))
        if gain[k] < -ALTERNATIVE or barred.sum() > PATIENCE:
            break
        tried = state.copy()
        tried.tau[k] = 0.0 if is_included[k] else sets.taus[int(np.argmax(c.tau_weights[k]))]
        now = sets.score(sets.settled(tried))
        if now > best:
            state, best = tried, now
            barred = away.copy()
            # The odds at the widths before are near enough to choose what to try next.
            c = sets.conditional(state, follow=True)
            _take_likeliest(sets, state, c)
        else:
            barred[k] = True
    return sets.settled(state)


def everything(sets: Sets) -> State:
    """Every group at its typical size, but those of which one of many may be there."""
    return State(np.where(sets.free & (sets.share == 1) & (sets.price == 0), 1.0, sets.empty().tau))


def thin_out(sets: Sets) -> State:
    """Start from all groups and remove the least needed until all are needed; return the likeliest set."""
    state = sets.settled(everything(sets))
    best, best_state = -np.inf, state.copy()
    c = sets.conditional(state)
    while True:
        if c.score > best:
            best, best_state = c.score, state.copy()
        odds = np.where((state.tau > 0) & sets.free, c.log_odds, np.inf)
        if odds.min(initial=np.inf) > NEEDED:
            return best_state
        # Of those that may be there alone one after the other: the last is not impossible any more.
        at_once = 1 if odds.min() < NEVER / 2 else max(1, int(np.sum(odds < 0)) // PATIENCE)
        worst = np.argsort(odds)[:at_once]
        state.tau[worst] = 0.0
        c, unit = retune(sets, state), state.unit
        if sets.settled(state).unit != unit:
            c = sets.conditional(state)


def retune(sets: Sets, state: State, *, follow: bool = False) -> Conditional:
    """Put every group at its likeliest variance; return the conditional posterior there."""
    c = sets.conditional(state, follow=follow)
    return sets.conditional(state, follow=follow) if _take_likeliest(sets, state, c) else c


def _take_likeliest(sets: Sets, state: State, c: Conditional) -> bool:
    """Put every group at its likeliest variance; return whether that changes any."""
    is_included = (state.tau > 0) & sets.is_learnt
    tau = sets.taus[np.argmax(c.tau_weights[is_included], axis=1)]
    is_new = not np.array_equal(tau, state.tau[is_included])
    state.tau[is_included] = tau
    return is_new
