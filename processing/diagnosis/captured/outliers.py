"""Hits (cosmic rays, bit errors) and bad pixels: what stands out of its own pixel, or of the pixels around.

The model, and what the residual of the whole image has in common, are taken away first: any fault of the instrument
that is linear in the light goes with them. A hit is one intensity that is far from what the other states of its pixel
say; a bad pixel is noisier than its neighbours in all states. At an edge that moves, neighbours and other states are as
far off, and nothing stands out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.captured.common_rest import Whitened, robust_scale
from processing.diagnosis.search.rules import (
    ALSO_BAD,
    BAD_DEVIATIONS,
    BAD_PIXEL,
    BRIGHTEST,
    DIMMEST,
    FEWEST_FOR_HITS,
    FEWEST_FREE_FOR_HITS,
    HIT,
    MOST_HITS,
    MOST_STRUCK,
    SIDE_AROUND,
)

#: [of the variance of a state] Least part that a fit leaves of it: that of none is zero.
LEAST_FREE = 1e-6


@dataclass(frozen=True)
class Outliers:
    """What is left out: `hits` (N, channels, rows, columns) single intensities, `bad` (rows, columns) pixels."""

    hits: NDArray[np.bool_]
    bad: NDArray[np.bool_]


def outliers_of(data: CaptureData, a: Array) -> Outliers:
    """Hits and bad pixels of a capture against rows a (L, K) of its model."""
    rows = data.values_per_pixel
    good, keep = data.usable & ~data.clipped, data.row_counts
    hits, bad = np.zeros((rows, good.size), dtype=bool), np.zeros(good.shape, dtype=bool)
    found = Outliers(hits.reshape(data.signal.shape), bad)
    if good.sum() < FEWEST_FOR_HITS:
        return found
    white = Whitened.of(data, a, good)
    if white.outside.shape[1] < FEWEST_FREE_FOR_HITS:
        return found
    # What is struck tells a noise of its own: no state is believed to be far brighter than the usual one of its pixel.
    usual = np.maximum(np.median(white.variance, axis=0), np.float32(DIMMEST))
    share = np.sqrt(np.clip(white.variance / usual, np.float32(DIMMEST), np.float32(BRIGHTEST)))
    clean = np.ones(white.y.shape[1], dtype=bool)
    # Twice: what was struck is no structure of the image.
    for _ in range(2):
        rest = white.rest(clean)
        # In standard deviations as the image itself shows them: what is declared of the noise is not asked.
        r = np.asarray(rest.astype(np.float32) @ white.y / np.sqrt(usual), dtype=np.float32)
        t = np.asarray(r / share, dtype=np.float32)
        size = np.sqrt(np.diag(rest))[:, None]
        scale = (robust_scale(t if clean.all() else t[:, clean]) / size).astype(np.float32)
        noise = np.asarray(share * scale / np.median(scale), dtype=np.float32)
        r /= np.median(scale)
        t /= size.astype(np.float32) * scale
        struck, noisy = _hits(r, t, noise, rest)
        clean = (np.max(np.abs(t), axis=0) < HIT) & ~struck.any(axis=0)
        if clean.all() or clean.sum() < FEWEST_FOR_HITS:
            break
    hits[np.ix_(keep, good.reshape(-1))] = struck
    map_of = np.full(good.shape, float(np.median(noisy)))
    map_of[good] = noisy
    bad[...] = good & _noisier_than_around(map_of, white.outside.shape[1])
    return found


def _hits(
    r: NDArray[np.float32], t: NDArray[np.float32], noise: NDArray[np.float32], rest: Array
) -> tuple[NDArray[np.bool_], Array]:
    """Hits (L, P), and the mean square (P,) of what is left beside them, in standard deviations.

    A hit shows in all states through the fit: the strongest is left out of the fit, and the next is looked for.
    `r` (L, P): residuals as `rest` gives them, over the noise of the usual state of the pixel; `noise` (L, P): that of
    each state over it; `t` (L, P): residuals in standard deviations.
    """
    hits = np.zeros(t.shape, dtype=bool)
    noisy = np.asarray(np.mean(t**2, axis=0, dtype=float))
    for p in np.flatnonzero(np.max(np.abs(t), axis=0) > HIT):
        left, q = r[:, p].astype(float), rest.copy()
        struck: list[int] = []
        found: tuple[list[int], float] = ([], float(noisy[p]))
        while len(struck) < MOST_STRUCK:
            free = np.maximum(np.diag(q), LEAST_FREE)
            # One hit is strongest where it struck: so it goes with a projection, whatever the noise of each state.
            k = int(np.argmax(np.abs(left) / np.sqrt(free)))
            far = abs(left[k]) / np.sqrt(free[k]) / noise[k, p]
            left, q = left - q[:, k] * left[k] / free[k], q - np.outer(q[:, k], q[k]) / free[k]
            struck.append(k)
            square = float(np.sum((left / noise[:, p]) ** 2) / max(np.trace(q), 1.0))
            if far > HIT * max(np.sqrt(square), 1.0):
                found = struck.copy(), square
        hits[found[0], p], noisy[p] = True, found[1]
    hits[hits.mean(axis=1) > MOST_HITS] = False
    return hits, noisy


def _noisier_than_around(noisy: Array, free: int) -> NDArray[np.bool_]:
    """Pixels (rows, columns) with far more noise than those around them, and than the image."""
    around = ndimage.percentile_filter(noisy, 100 * (1 - ALSO_BAD), size=SIDE_AROUND)
    least = max(BAD_PIXEL, 1 + BAD_DEVIATIONS * float(np.sqrt(2 / free)))
    return np.asarray(noisy > least * np.maximum(around, np.median(noisy)))


def without(data: CaptureData, found: Outliers) -> CaptureData:
    """The capture with the pixels of outliers left out, and their counts filled in from the pixels around.

    A pixel is left out whole, since the moments need all its states; what is filled in serves image derivatives.
    """
    every = found.hits | found.bad
    signal = data.signal.copy()
    box = np.ones((3, 3), dtype=np.float32)
    for n, c in np.argwhere(every.any(axis=(2, 3))):
        frame, lost = signal[n, c], every[n, c]
        weight = ndimage.convolve((~lost).astype(np.float32), box, mode="nearest")
        mean = ndimage.convolve(np.where(lost, 0, frame), box, mode="nearest") / np.maximum(weight, 1)
        frame[lost] = np.where(weight > 0, mean, np.median(frame[~lost]))[lost]
    return replace(data, signal=signal, usable=data.usable & ~every.any(axis=(0, 1)))
