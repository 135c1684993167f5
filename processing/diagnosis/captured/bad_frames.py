"""Frames that belong to nothing: a shutter half closed, an axis that stood elsewhere, a frame of another run.

And two that were stored in each other's place, of which single values for each state would make anything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.search.range_of import range_of
from processing.diagnosis.search.rules import (
    AGAINST_NEXT,
    LEAST_MISFIT,
    MOST_BAD_FRAMES,
    MOSTLY,
    SUSPECTS_OF_EXCHANGE,
    UNPREDICTED,
)


@dataclass(frozen=True)
class BadFrame:
    """A state that belongs to nothing, and the rms of its misfit relative to the signal of all states.

    `instead` is the state in whose place its frame is.
    """

    state: int
    misfit: float
    instead: int | None = None


def bad_frames(data: CaptureData, a: Array) -> tuple[BadFrame, ...]:
    """States that the others do not predict, or else two in each other's place, against rows a (L, K) of the model.

    Faults of the model make many states misfit, none by itself.
    """
    states, channels = data.signal.shape[:2]
    good = data.usable & ~data.clipped
    if not good.any():
        return ()
    y = data.signal[:, :, good].reshape(data.values_per_pixel, -1).astype(np.float64)
    noise = data.variance_of(good).mean(axis=2).reshape(-1)
    bright = float(np.mean(y**2))
    moments = _Moments(y @ y.T / y.shape[1] / bright, noise * data.noise_known / bright, a, channels)
    left = [k for k in range(states) if data.row_counts[k * channels]]
    found: list[BadFrame] = []
    before = moments.suspect(left)
    while before is not None and len(found) < MOST_BAD_FRAMES * states:
        rest = [k for k in left if k != before.state]
        after = moments.suspect(rest)
        if after is None or before.misfit < LEAST_MISFIT or before.misfit**2 < AGAINST_NEXT * after.misfit**2:
            break
        if moments.left(rest) > (1 - MOSTLY) * moments.left(left):
            break
        found.append(before)
        left, before = rest, after
    return tuple(found) or moments.exchanged(left)


class _Moments:
    """Second moments (L, L) of the signal over its mean square, and how a fit to some states leaves them."""

    def __init__(self, products: Array, noise: Array, a: Array, channels: int) -> None:
        self._products, self._noise, self._a, self._channels = products, noise, a, channels

    def _rows(self, states: Sequence[int]) -> NDArray[np.int64]:
        return (np.asarray(states)[:, None] * self._channels + np.arange(self._channels)).reshape(-1)

    def _outside(self, rows: NDArray[np.int64]) -> Array:
        q = range_of(self._a[rows])
        return np.asarray(np.eye(len(rows)) - q @ q.T)

    def _fitted(self, states: Sequence[int]) -> tuple[Array, Array]:
        """What (L', L') a fit to some states leaves of their rows, and their second moments (L', L') beyond noise."""
        rows = self._rows(states)
        return self._outside(rows), self._products[np.ix_(rows, rows)] - np.diag(self._noise[rows])

    def left(self, states: Sequence[int]) -> float:
        """Mean square beyond noise that a fit to some states leaves, summed over the states."""
        p, beyond = self._fitted(states)
        return max(float(np.sum(p * beyond)), 1e-300)

    def suspect(self, states: Sequence[int]) -> BadFrame | None:
        """The state that differs most from what the others predict; None where they do not predict any."""
        p, signal = self._fitted(states)
        beyond = p @ signal @ p
        c = self._channels
        worst = None
        for j, state in enumerate(states):
            mine = slice(j * c, (j + 1) * c)
            free = p[mine, mine]
            # A residual, over what is free of the state, is its difference from the prediction by the others.
            if np.linalg.cond(free) > UNPREDICTED:
                continue
            back = np.linalg.inv(free)
            misfit = float(np.sqrt(max(np.trace(back @ beyond[mine, mine] @ back.T), 0.0) / c))
            if worst is None or misfit > worst.misfit:
                worst = BadFrame(state, misfit)
        return worst

    def exchanged(self, states: Sequence[int]) -> tuple[BadFrame, ...]:
        """The two of which each fits in the other's place, and most of what is left over goes; or none."""
        p, beyond = self._fitted(states)
        least, pair = (1 - MOSTLY) * self.left(states), None
        where = np.arange(len(p)).reshape(len(states), self._channels)
        worst = np.argsort(-np.diag(p @ beyond @ p).reshape(where.shape).sum(axis=1))[:SUSPECTS_OF_EXCHANGE]
        for i, j in combinations(sorted(worst.tolist()), 2):
            order = where.copy()
            order[[i, j]] = order[[j, i]]
            left = float(np.sum(p * beyond[np.ix_(order.reshape(-1), order.reshape(-1))]))
            if left < least:
                least, pair = left, (i, j)
        if pair is None:
            return ()
        first, second = (where[k] for k in pair)
        apart = beyond[first, first] + beyond[second, second] - 2 * beyond[first, second]
        misfit = float(np.sqrt(max(apart.mean(), 0.0)))
        i, j = (states[k] for k in pair)
        return (BadFrame(i, misfit, j), BadFrame(j, misfit, i)) if misfit >= LEAST_MISFIT else ()
