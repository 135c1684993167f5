"""Outliers of a capture: bad frames, hits (cosmic rays, bit errors) and bad pixels.

The model, and what the residual of the whole image has in common, are subtracted first. They contain any fault of the
instrument that is linear in the light. A hit is one intensity that differs from the prediction of the other states of
its pixel. A bad pixel is noisier than its neighbours in all states. A bad frame is a state that the others do not
predict, or two states in each other's place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtri

from processing.arrays import Array
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.search.range_of import NEARLY_ZERO, inside_and_outside, range_of
from processing.diagnosis.search.rules import (
    ENOUGH_PX,
    FEWEST_FREE,
    FEWEST_OF_MANY,
    GROWTH,
    LIMIT,
    LITTLE,
    MOST_SPOILT,
    MOSTLY,
    SMALL,
)

#: [robust standard deviations] From which on an intensity is a hit: the largest of 10^9 normal ones is 6.1.
HIT = 8.0
#: [states] Of one pixel that are hits; with more of them it is a bad pixel.
MOST_STRUCK = 4
#: [of the usual variance] From which on a pixel is bad, and up to which the noise of a bright state is believed.
BAD_PIXEL = 4.0
#: [pixels] Side of the square of pixels around: an image that moves makes more of them noisy, a bad pixel is alone.
SIDE_AROUND = 5
#: [of the 25 pixels around] That may be as bad: at an edge that moves more of them are.
ALSO_BAD = 0.2
#: [of the signal] Rms by which a bad frame differs from what all others predict: a source or an axis that is merely
#: unsteady stays below.
LEAST_MISFIT = 0.015
#: [1] Times by which its misfit is larger, squared, than the next one that is left without it.
AGAINST_NEXT = 8.0
#: [states] With most left over, of which pairs are tried in each other's place: all pairs of 400 would take a minute.
SUSPECTS_OF_EXCHANGE = 12

#: [standard deviations] Median of absolute values of normal ones.
NORMAL_MAD = float(ndtri(0.75))


@dataclass(frozen=True)
class Whitened:
    """Some pixels of a capture, every row in units of its noise.

    Attributes
    ----------
    y : (L, P) intensities of the rows that count; variance : (L, P), one on average.
    level : (L,) noise of each row in full scales; inside : (L, K), outside : (L, free) orthonormal directions that the
        unknowns of a pixel reach, and do not reach.
    """

    y: NDArray[np.float32]
    variance: NDArray[np.float32]
    level: Array
    inside: Array
    outside: Array

    @classmethod
    def of(cls, data: CaptureData, a: Array, good: NDArray[np.bool_]) -> Whitened:
        """Pixels `good` (rows, columns) against rows a (L, K) of the model."""
        rows, keep = data.values_per_pixel, data.row_counts
        y = data.signal.reshape(rows, -1)[np.ix_(keep, good.reshape(-1))]
        variance = data.variance(good).reshape(rows, -1)[keep].astype(np.float32)
        mean = np.mean(variance, axis=1, dtype=float)
        # That of a row without any is zero.
        level = np.sqrt(np.maximum(mean, LITTLE * mean.max()))
        y /= level[:, None].astype(np.float32)
        variance /= (level[:, None] ** 2).astype(np.float32)
        return cls(y, variance, level, *inside_and_outside(a[keep] / level[:, None]))

    def projector(self, clean: NDArray[np.bool_]) -> Array:
        """Projection (L, L) on what neither the model reaches nor the residual of the `clean` pixels has in common."""
        outside = self.outside.astype(np.float32)
        y, variance = (self.y, self.variance) if clean.all() else (self.y[:, clean], self.variance[:, clean])
        r = outside @ (outside.T @ y)
        scale = robust_scale(r).astype(np.float32)
        inner = (outside.T @ np.clip(r, -LIMIT * scale, LIMIT * scale, out=r)).astype(float)
        value, vector = np.linalg.eigh(inner @ inner.T / inner.shape[1])
        # Largest eigenvalue of noise over the median one (Marchenko and Pastur); beyond it all pixels share structure.
        # Of bright pixels beside dark ones only the bright ones count, as they have most of the noise.
        edge = GROWTH * (1 + np.sqrt(len(value) / count_equal(variance.mean(axis=0, dtype=float)))) ** 2
        # At least half of the directions are left to tell what noise is.
        half = len(value) // 2
        structure = self.outside @ vector[:, half:][:, value[half:] > edge * np.median(value)]
        return np.asarray(self.outside @ self.outside.T - structure @ structure.T)


def count_equal(variance: Array) -> float:
    """Number of pixels of equal variance whose mean square scatters as that of pixels of these variances (P,)."""
    return float(variance.sum() ** 2 / max(float(np.sum(variance**2)), 1e-300))


def robust_scale(r: NDArray[np.floating]) -> Array:
    """Robust standard deviation (L, 1) of every row; of many pixels some tell it."""
    r = r[:, :: r.shape[1] // ENOUGH_PX + 1]
    return np.asarray(np.maximum(np.median(np.abs(r), axis=1, keepdims=True) / NORMAL_MAD, 1e-12))


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
    noise = data.variance(good).mean(axis=2).reshape(-1)
    bright = float(np.mean(y**2))
    moments = _Moments(y @ y.T / y.shape[1] / bright, noise * data.noise_known / bright, a, channels)
    state_indices = [k for k in range(states) if data.row_counts[k * channels]]
    bad: list[BadFrame] = []
    before = moments.suspect(state_indices)
    while before is not None:
        subset = [k for k in state_indices if k != before.state]
        after = moments.suspect(subset)
        if after is None or before.misfit < LEAST_MISFIT or before.misfit**2 < AGAINST_NEXT * after.misfit**2:
            break
        if moments.excess(subset) > (1 - MOSTLY) * moments.excess(state_indices):
            break
        bad.append(before)
        state_indices, before = subset, after
    return tuple(bad) or moments.find_exchange(state_indices)


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
        """Projector (L', L') on the residual of a fit to some states, and second moments (L', L') beyond noise."""
        rows = self._rows(states)
        return self._outside(rows), self._products[np.ix_(rows, rows)] - np.diag(self._noise[rows])

    def excess(self, states: Sequence[int]) -> float:
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
            block = slice(j * c, (j + 1) * c)
            free = p[block, block]
            # A residual, over what is free of the state, is its difference from the prediction by the others.
            if np.linalg.cond(free) * NEARLY_ZERO > 1:
                continue
            back = np.linalg.inv(free)
            misfit = float(np.sqrt(max(np.trace(back @ beyond[block, block] @ back.T), 0.0) / c))
            if worst is None or misfit > worst.misfit:
                worst = BadFrame(state, misfit)
        return worst

    def find_exchange(self, states: Sequence[int]) -> tuple[BadFrame, ...]:
        """The two of which each fits in the other's place, and most of what is left over goes; or none."""
        p, beyond = self._fitted(states)
        least, pair = (1 - MOSTLY) * self.excess(states), None
        where = np.arange(len(p)).reshape(len(states), self._channels)
        worst = np.argsort(-np.diag(p @ beyond @ p).reshape(where.shape).sum(axis=1))[:SUSPECTS_OF_EXCHANGE]
        for i, j in combinations(sorted(worst.tolist()), 2):
            order = where.copy()
            order[[i, j]] = order[[j, i]]
            excess = float(np.sum(p * beyond[np.ix_(order.reshape(-1), order.reshape(-1))]))
            if excess < least:
                least, pair = excess, (i, j)
        if pair is None:
            return ()
        first, second = (where[k] for k in pair)
        apart = beyond[first, first] + beyond[second, second] - 2 * beyond[first, second]
        misfit = float(np.sqrt(max(apart.mean(), 0.0)))
        i, j = (states[k] for k in pair)
        return (BadFrame(i, misfit, j), BadFrame(j, misfit, i)) if misfit >= LEAST_MISFIT else ()


def outliers_of(data: CaptureData, a: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Hits (N, channels, rows, columns) and bad pixels (rows, columns) against rows a (L, K) of the model."""
    good, keep = data.usable & ~data.clipped, data.row_counts
    hits, bad = np.zeros(data.signal.shape, dtype=bool), np.zeros(good.shape, dtype=bool)
    if good.sum() < FEWEST_OF_MANY:
        return hits, bad
    white = Whitened.of(data, a, good)
    if white.outside.shape[1] < FEWEST_FREE:
        return hits, bad
    # What is struck tells a noise of its own: no state is believed to be far brighter than the usual one of its pixel.
    usual = np.maximum(np.median(white.variance, axis=0), np.float32(SMALL))
    share = np.sqrt(np.clip(white.variance / usual, np.float32(SMALL), np.float32(BAD_PIXEL)))
    clean = np.ones(white.y.shape[1], dtype=bool)
    # Twice: what was struck is no structure of the image.
    for _ in range(2):
        projector = white.projector(clean)
        # In standard deviations as the image itself shows them: what is declared of the noise is not asked.
        r = np.asarray(projector.astype(np.float32) @ white.y / np.sqrt(usual), dtype=np.float32)
        t = np.asarray(r / share, dtype=np.float32)
        size = np.sqrt(np.diag(projector))[:, None]
        scale = (robust_scale(t if clean.all() else t[:, clean]) / size).astype(np.float32)
        noise = np.asarray(share * scale / np.median(scale), dtype=np.float32)
        r /= np.median(scale)
        t /= size.astype(np.float32) * scale
        struck, noisy = _hits(r, t, noise, projector)
        clean = (np.max(np.abs(t), axis=0) < HIT) & ~struck.any(axis=0)
        if clean.all() or clean.sum() < FEWEST_OF_MANY:
            break
    hits.reshape(len(keep), -1)[np.ix_(keep, good.reshape(-1))] = struck
    map_of = np.full(good.shape, float(np.median(noisy)))
    map_of[good] = noisy
    return hits, good & _noisier_than_around(map_of, white.outside.shape[1])


def _hits(
    r: NDArray[np.float32], t: NDArray[np.float32], noise: NDArray[np.float32], projector: Array
) -> tuple[NDArray[np.bool_], Array]:
    """Hits (L, P), and the mean square (P,) of what is left beside them, in standard deviations.

    A hit shows in all states through the fit: the strongest is left out of the fit, and the next is looked for.
    `r` (L, P): residuals of `projector` over the noise of the usual state of the pixel; `noise` (L, P): that of each
    state over it; `t` (L, P): residuals in standard deviations.
    """
    hits = np.zeros(t.shape, dtype=bool)
    noisy = np.asarray(np.mean(t**2, axis=0, dtype=float))
    for p in np.flatnonzero(np.max(np.abs(t), axis=0) > HIT):
        residual, q = r[:, p].astype(float), projector.copy()
        struck: list[int] = []
        selection: tuple[list[int], float] = ([], float(noisy[p]))
        while len(struck) < MOST_STRUCK:
            free = np.maximum(np.diag(q), NEARLY_ZERO)
            # One hit is strongest where it struck: so it goes with a projection, whatever the noise of each state.
            k = int(np.argmax(np.abs(residual) / np.sqrt(free)))
            far = abs(residual[k]) / np.sqrt(free[k]) / noise[k, p]
            residual, q = residual - q[:, k] * residual[k] / free[k], q - np.outer(q[:, k], q[k]) / free[k]
            struck.append(k)
            square = float(np.sum((residual / noise[:, p]) ** 2) / max(np.trace(q), 1.0))
            if far > HIT * max(np.sqrt(square), 1.0):
                selection = struck.copy(), square
        hits[selection[0], p], noisy[p] = True, selection[1]
    # With more of them the frame itself moved, or belongs to nothing.
    hits[hits.mean(axis=1) > MOST_SPOILT] = False
    return hits, noisy


def _noisier_than_around(noisy: Array, free: int) -> NDArray[np.bool_]:
    """Pixels (rows, columns) with far more noise than those around them, and than the image."""
    around = ndimage.percentile_filter(noisy, 100 * (1 - ALSO_BAD), size=SIDE_AROUND)
    least = max(BAD_PIXEL, 1 + HIT * float(np.sqrt(2 / free)))
    return np.asarray(noisy > least * np.maximum(around, np.median(noisy)))


def remove_outliers(data: CaptureData, every: NDArray[np.bool_]) -> CaptureData:
    """The capture without the pixels of outliers (N, channels, rows, columns), filled in from the pixels around.

    A pixel is left out whole, since the moments need all its states; what is filled in serves image derivatives.
    """
    signal = data.signal.copy()
    box = np.ones((3, 3), dtype=np.float32)
    for n, c in np.argwhere(every.any(axis=(2, 3))):
        frame, lost = signal[n, c], every[n, c]
        weight = ndimage.convolve((~lost).astype(np.float32), box, mode="nearest")
        mean = ndimage.convolve(np.where(lost, 0, frame), box, mode="nearest") / np.maximum(weight, 1)
        frame[lost] = np.where(weight > 0, mean, np.median(frame[~lost]))[lost]
    return replace(data, signal=signal, usable=data.usable & ~every.any(axis=(0, 1)))
