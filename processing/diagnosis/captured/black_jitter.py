"""A black level that is another one in every frame, as the parts of the images show that hardly any light reaches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.captured.common_rest import NORMAL_MAD
from processing.diagnosis.search.range_of import inside_and_outside, range_of
from processing.diagnosis.search.rules import DIM, FEWEST_DIM, LIT, MOSTLY, NOISE_SURE
from processing.instrument.grammar import TIMES, course

#: [1, fixed] Variance of a median over that of a mean.
MEDIAN = np.pi / 2


def black_jitter(data: CaptureData, a: Array) -> tuple[Array, float] | None:
    """Offset (L,) of every row, as far as it is not what the light of a pixel could be, and the variance of the whole.

    In full scales; None where none shows. An offset changes dim pixels as much as bright ones, what happens to light
    changes them by as much less as they are dimmer. `a` (L, K): rows of the model, which both may follow.
    """
    rows = data.row_counts
    y = data.signal.reshape(data.values_per_pixel, *data.usable.shape)[rows]
    mean = y.mean(axis=0, dtype=np.float64)
    lit = data.usable & ~data.clipped
    if not lit.any():
        return None
    lit &= mean > LIT * np.median(mean[lit])
    dim = np.any(y != 0, axis=0) & (mean < DIM * mean[lit].mean())
    _, outside = inside_and_outside(a[rows])
    free = outside.shape[1]
    if dim.sum() < FEWEST_DIM or not free:
        return None
    # Hits and bad pixels are among them.
    level = np.median(y[:, dim], axis=1).astype(np.float64)
    scatter = np.median(np.abs(y[:, dim] - level[:, None]), axis=1) / NORMAL_MAD
    noise = MEDIAN * float(np.mean(scatter**2)) / int(dim.sum())
    if not _alike_in_halves(y[:, dim], mean[dim], outside, noise):
        return None
    seen, bright = outside.T @ level, outside.T @ y[:, lit].mean(axis=1, dtype=np.float64)
    if float(seen @ seen) < noise * (free + NOISE_SURE * np.sqrt(2 * free)):
        return None
    follows, light = float(bright @ seen / (seen @ seen)), float(mean[lit].mean() / max(mean[dim].mean(), 1e-300))
    # Nearer to light than to an offset, which bright pixels follow once.
    if follows**2 > light:
        return None
    if _is_a_course(data, seen, outside):
        return None
    offsets = np.zeros(data.values_per_pixel)
    offsets[rows] = outside @ (seen - bright / light)
    return offsets, float(np.sum(offsets**2)) / free


def _is_a_course(data: CaptureData, seen: Array, outside: Array) -> bool:
    """Whether most of it is a course over time: a fault, of which to take off a part alone would hide the rest."""
    conditions = data.conditions
    courses = np.concatenate([course(name, conditions) for name in TIMES]).repeat(len(conditions.channels), axis=1)
    along = range_of(outside.T @ courses[:, data.row_counts].T)
    return bool(np.sum((along.T @ seen) ** 2) > MOSTLY * (seen @ seen))


def _alike_in_halves(y: NDArray[np.float32], mean: Array, outside: Array, noise: float) -> bool:
    """Whether the brighter half of dim pixels (L, P) shows the same as the darker one, as an offset does.

    What happens to light grows with it, and is another thing on another material. `noise` is the variance of a median
    over all of them.
    """
    bright = mean > np.median(mean)
    if bright.all() or not bright.any():
        return True
    one, other = (outside.T @ np.median(y[:, half], axis=1).astype(np.float64) for half in (bright, ~bright))
    free, apart = outside.shape[1], one - other
    # Each has twice the variance of the whole, their difference four times.
    return bool(apart @ apart < 4 * noise * (free + NOISE_SURE * np.sqrt(2 * free)))
