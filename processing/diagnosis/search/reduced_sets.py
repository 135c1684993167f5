"""The same sets of groups without what needs no visit: what is certain to be there, states at which no axis slipped.

Forty values of a source for each capture are nearly all of the work, though nothing else could stand in their place;
they are projected out, and come back into mean and covariance afterwards.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.rules import CERTAIN, SHARES
from processing.diagnosis.search.sets import Group, Quadratic, Sets, State


class ReducedSets:
    """Sets beside the certain groups of a likely state; their variances and the unit of chi-square stay as they are.

    Attributes
    ----------
    sets : of the groups `kept` (R,), numbers among all; `certain` (C,) are always there.
    start : the likely state in them.
    """

    def __init__(self, whole: Sets, state: State) -> None:
        self._whole, self._state = whole, state
        certain, odds = _worth(whole, state)
        plausible = (whole.share == 1) | (odds > np.log(SHARES / (1 - SHARES)))
        if (certain & whole.alone).any():
            plausible &= ~whole.alone
        self.certain, self.kept = np.flatnonzero(certain), np.flatnonzero(plausible & ~certain)
        self._out, self._in = _positions(whole, self.certain), _positions(whole, self.kept)
        unit, form = state.unit, whole.form
        prior = [np.full(whole.groups[k].index.size, state.tau[k] ** -2.0) for k in self.certain]
        own = form.curvature[np.ix_(self._out, self._out)] / unit + np.diag(np.concatenate([np.zeros(0), *prior]))
        self._covariance = np.linalg.inv(own)
        cross = form.curvature[np.ix_(self._out, self._in)]
        # What is projected out has the mean self._mean + self._turn @ x of all others.
        self._mean = -self._covariance @ form.gradient[self._out] / unit
        self._turn = -self._covariance @ cross / unit
        curvature = form.curvature[np.ix_(self._in, self._in)] + cross.T @ self._turn
        left = Quadratic(
            float(form.excess + form.gradient[self._out] @ self._mean),
            form.gradient[self._in] + cross.T @ self._mean,
            (curvature + curvature.T) / 2,
        )
        there = int(np.sum(whole.free[self.certain]))
        self.sets = whole.among(left, self.kept, _renumbered(whole, self.kept), there)
        self.start = State(state.tau[self.kept].copy(), unit)

    def lifted(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
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
        tau[self.certain], tau[self.kept] = self._state.tau[self.certain], state.tau
        return State(tau, state.unit)


def _worth(sets: Sets, state: State) -> tuple[NDArray[np.bool_], Array]:
    """Groups (G,) that are certain, and the log odds (G,) of each beside the others or in the place of one."""
    there = state.tau > 0
    certain = there & ~sets.free
    reach = sets.conditional(state).log_odds
    for k in np.flatnonzero(there & sets.free):
        odds = sets.conditional(sets.without(state, int(k))).log_odds
        instead = np.where(there, -np.inf, odds) - max(odds[k], 0.0)
        reach = np.maximum(reach, instead)
        large = bool(sets.many[k])
        certain[k] = large and odds[k] > CERTAIN and instead.max(initial=-np.inf) < -CERTAIN
    return certain, np.where(there, np.inf, reach)


def _positions(sets: Sets, groups: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate([np.zeros(0, dtype=np.int64), *(sets.groups[k].index for k in groups)])


def _renumbered(sets: Sets, groups: NDArray[np.int64]) -> list[Group]:
    out, first = [], 0
    for k in groups:
        size = sets.groups[k].index.size
        out.append(replace(sets.groups[k], index=np.arange(first, first + size)))
        first += size
    return out
