"""A black level that is another one in every frame, from pixels that hardly see light."""

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.captures.outliers import NORMAL_MAD
from processing.diagnosis.search.range_of import inside_and_outside, range_of
from processing.diagnosis.search.rules import FEWEST_PIXELS, LIMIT, MOSTLY, SMALL
from processing.instrument.grammar import TIMES, course
from processing.reduction.noise import QUANTIZATION


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
    lit &= mean > MOSTLY * np.median(mean[lit])
    dim = np.any(y != 0, axis=0) & (mean < SMALL * mean[lit].mean())
    _, outside = inside_and_outside(a[rows])
    free = outside.shape[1]
    if dim.sum() < FEWEST_PIXELS or not free:
        return None
    level, noise = _dim_levels(y[:, dim], 1 / data.conditions.full_scale)
    if not _halves_agree(y[:, dim], mean[dim], outside, 1 / data.conditions.full_scale):
        return None
    black, bright = outside.T @ level, outside.T @ y[:, lit].mean(axis=1, dtype=np.float64)
    if not _is_significant(black, noise, free):
        return None
    slope, light = float(bright @ black / (black @ black)), float(mean[lit].mean() / max(mean[dim].mean(), 1e-300))
    # Nearer to light than to an offset, which bright pixels follow once.
    if slope**2 > light:
        return None
    along = _courses(data, outside)
    if np.sum((along.T @ black) ** 2) > MOSTLY * (black @ black):
        # A fault, of which to take off a part alone would hide the rest; it may go in steps of whole counts.
        black, bright = (v - along @ (along.T @ v) for v in (black, bright))
        if not _is_significant(black, noise, free - along.shape[1]):
            return None
    offsets = np.zeros(data.values_per_pixel)
    offsets[rows] = outside @ (black - bright / light)
    return offsets, float(np.sum(offsets**2)) / free


def _dim_levels(y: NDArray[np.float32], count: float) -> tuple[Array, float]:
    """Mean (L,) of dim pixels (L, P) with hits and bad pixels cut back, and its variance.

    The mean of whole counts is off by a part of a `count` where noise does not spread them (Widrow and Kollar,
    Quantization Noise, Cambridge 2008, chapter 4).
    """
    # Pixels differ in all states alike: that is no noise, though it spreads the counts.
    spread = np.maximum(y.var(axis=1, dtype=np.float64) / count**2 - QUANTIZATION, 0.0)
    deviation = y - y.mean(axis=0, dtype=np.float64)
    middle = np.median(deviation, axis=1, keepdims=True)
    scatter = np.median(np.abs(deviation - middle), axis=1, keepdims=True) / NORMAL_MAD
    reach = LIMIT * np.maximum(scatter, count / 2)
    clipped = np.clip(deviation, middle - reach, middle + reach)
    rounding = (count / np.pi) ** 2 / 2 * np.exp(-4 * np.pi**2 * spread)
    level = clipped.mean(axis=1) + y.mean(dtype=np.float64)
    return level, float(np.mean(clipped.var(axis=1) / y.shape[1] + rounding))


def _is_significant(levels: Array, noise: float, free: int) -> bool:
    """Whether levels in `free` directions are more than their noise."""
    return bool(levels @ levels >= noise * (free + LIMIT * np.sqrt(2 * free)))


def _courses(data: CaptureData, outside: Array) -> Array:
    """Orthonormal courses over time (free, n), in the directions that the light leaves over."""
    conditions = data.conditions
    courses = np.concatenate([course(name, conditions) for name in TIMES]).repeat(len(conditions.channels), axis=1)
    return range_of(outside.T @ courses[:, data.row_counts].T)


def _halves_agree(y: NDArray[np.float32], mean: Array, outside: Array, count: float) -> bool:
    """Whether the brighter half of dim pixels (L, P) shows the same as the darker one, as an offset does.

    What happens to light grows with it, and is another thing on another material.
    """
    bright = mean > np.median(mean)
    if bright.all() or not bright.any():
        return True
    (first, v1), (second, v2) = (_dim_levels(y[:, half], count) for half in (bright, ~bright))
    free, difference = outside.shape[1], outside.T @ (first - second)
    return bool(difference @ difference < (v1 + v2) * (free + LIMIT * np.sqrt(2 * free)))
