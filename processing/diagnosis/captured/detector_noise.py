"""The noise of a detector as its own images show it, against what is declared of it.

What the model reaches, and what the residual of all pixels has in common, is taken away; differences of pixels a few
apart then have twice the variance of the noise, whatever the instrument does. How that depends on the distance, the
direction and the light tells kinds of noise apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.captured.common_rest import Whitened
from processing.diagnosis.search.rules import FEWEST_FREE_FOR_NOISE, LINES_APART, NARROWEST, NOT_ALIKE_PX

#: [intensities] Of the image that are looked at: enough for a part in a thousand of the noise.
MOST_VALUES = 4_000_000
#: [of what is declared] Least part of the variance that weights are made of.
LEAST_PART = 0.01
#: [unit of chi-square] Weight of the belief that both parts of the noise are as declared, where the images do not tell
#: them apart.
WEAK = 1e-3


@dataclass(frozen=True)
class DetectorNoise:
    """What the images show.

    Attributes
    ----------
    white, white_error : variance of a pixel over what is declared; each : mean of that over all pixels, whatever their
        light.
    shot, dark, covariance : the parts of the variance with and without light over what is declared, (2, 2);
        light_share : part of the variance declared that goes with the light.
    right, down : correlation of neighbours across and down; alike_error : its standard error.
    bent : variance of a pixel over what is declared, by a bend of the response that the residual may show: a response
        that flattens compresses noise too.
    rows, columns : variance that is common to a row, or a column, of a frame, over that of a pixel; rows_error.
    """

    white: float
    white_error: float
    each: float
    shot: float
    dark: float
    covariance: Array
    light_share: float
    right: float
    down: float
    alike_error: float
    bent: float
    rows: float
    columns: float
    rows_error: float


def detector_noise(data: CaptureData, a: Array) -> DetectorNoise | None:
    """Noise of a capture against rows a (L, K) of its model; None where its images do not show it."""
    height, width = data.usable.shape
    if min(height, width) < NARROWEST:
        return None
    rows = min(height, max(NARROWEST, MOST_VALUES // (width * data.values_per_pixel)))
    part = slice((height - rows) // 2, (height - rows) // 2 + rows)
    looked_at = np.zeros(data.usable.shape, dtype=bool)
    looked_at[part] = (data.usable & ~data.clipped)[part]
    if looked_at.sum() < NARROWEST**2:
        return None
    white = Whitened.of(data, a, looked_at)
    if white.outside.shape[1] < FEWEST_FREE_FOR_NOISE:
        return None
    rest = white.rest(np.ones(white.y.shape[1], dtype=bool))
    floor = np.repeat(data.floor, data.signal.shape[1])[data.row_counts] / white.level**2
    r, light, dark = np.full((3, len(rest), rows, width), np.nan)
    good = looked_at[part]
    r[:, good] = rest @ white.y
    dark[:, good] = (rest**2 @ floor)[:, None]
    light[:, good] = rest**2 @ white.variance - dark[:, good]
    return replace(_compared(r, light, dark, float(np.trace(rest)) / len(rest)), bent=_of_a_bend(white))


def _of_a_bend(white: Whitened) -> float:
    """Factor on the variance of the curve u + c u^2 that the residual fits best."""
    level = white.level[:, None].astype(np.float32)
    u = white.inside @ (white.inside.T @ white.y) * level
    bend = white.outside.T @ (u**2 / level)
    c = np.sum(bend * (white.outside.T @ white.y)) / max(float(np.sum(bend**2)), 1e-300)
    return float(np.mean(np.maximum(1 + 2 * c * u, 0.0) ** 2))


def _compared(r: Array, light: Array, dark: Array, free: float) -> DetectorNoise:
    expected = light + dark
    far = (NOT_ALIKE_PX, NOT_ALIKE_PX + 1)
    across = {lag: _half_square(r, expected, lag, 2) for lag in (1, *far)}
    down = {lag: _half_square(r, expected, lag, 1) for lag in (1, *far)}
    count = np.isfinite(r).sum() * free
    white = float(np.mean([across[lag] for lag in far]))
    error = white * float(np.sqrt(3 / count))
    rows = _common(r, expected, 2) - white * _within(r, 2, 1 - across[1] / white)
    columns = _common(r, expected, 1) - white * _within(r, 1, 1 - down[1] / white)
    number = free * r.shape[0] * np.array(r.shape[1:])
    # Means of a row scatter by the noise of a pixel over the number of its pixels.
    rows_error = float(white / r.shape[2] * np.sqrt(3 / number[0]))
    far_down = float(np.mean([down[lag] for lag in far]))
    shot, floor, covariance = _levels(r, light, dark, free)
    return DetectorNoise(
        white=white,
        white_error=error,
        each=float(np.mean([_of_each(r, expected, lag) for lag in far])),
        shot=shot,
        dark=floor,
        covariance=covariance,
        light_share=float(np.nansum(light) / np.nansum(expected)),
        right=1 - across[1] / white,
        down=1 - (down[1] - max(rows, 0.0)) / max(far_down - max(rows, 0.0), 1e-12),
        alike_error=float(np.sqrt(2 / count)),
        bent=1.0,
        rows=max(rows, 0.0) / white,
        columns=max(columns, 0.0) / white,
        rows_error=rows_error / white,
    )


def _pairs(x: Array, lag: int, axis: int) -> tuple[Array, Array]:
    before = (slice(None),) * axis
    return x[(*before, slice(-lag))], x[(*before, slice(lag, None))]


def _half_square(r: Array, expected: Array, lag: int, axis: int) -> float:
    """Half the square of differences over such a distance, over the variance that is expected."""
    first, second = _pairs(r, lag, axis)
    one, other = _pairs(expected, lag, axis)
    return float(np.nansum((first - second) ** 2) / np.nansum(np.where(np.isfinite(first - second), one + other, 0)))


def _of_each(r: Array, expected: Array, lag: int) -> float:
    """Squares of differences across so many pixels over the variance that is expected of all rows, mean over pixels."""
    first, second = _pairs(r, lag, 2)
    one, other = _pairs(expected, lag, 2)
    with np.errstate(invalid="ignore"):
        return float(np.nanmean(np.sum((first - second) ** 2, axis=0) / np.sum(one + other, axis=0)))


def _common(r: Array, expected: Array, axis: int) -> float:
    """The same of means over an axis, in units of the variance of a pixel."""
    counts = np.isfinite(r).sum(axis=axis)
    mean = np.nansum(r, axis=axis) / np.maximum(counts, 1)
    first, second = _pairs(np.where(counts > 0, mean, np.nan), LINES_APART, 1)
    one, other = _pairs(np.nansum(expected, axis=axis) / np.maximum(counts, 1), LINES_APART, 1)
    used = np.isfinite(first - second)
    return float(np.sum((first - second)[used] ** 2) / np.sum((one + other)[used]))


def _within(r: Array, axis: int, alike: float) -> float:
    """Variance of a mean over an axis over that of a pixel, if only neighbours are alike."""
    counts = np.isfinite(r).sum(axis=axis)
    return float(np.mean(1 / counts[counts > 0]) * (1 + 2 * max(alike, 0.0)))


def _levels(r: Array, light: Array, dark: Array, free: float) -> tuple[float, float, Array]:
    """Parts of the variance with and without light over what is declared, and their covariance."""
    first, second = _pairs(r, NOT_ALIKE_PX, 2)
    half = (first - second) ** 2 / 2
    used = np.isfinite(half)
    design = np.stack([np.mean(_pairs(x, NOT_ALIKE_PX, 2), axis=0)[used] for x in (light, dark)], axis=1)
    found = np.ones(2)
    for _ in range(3):
        weight = 1 / (design @ np.maximum(found, LEAST_PART)) ** 2
        normal = (design * weight[:, None]).T @ design + WEAK * np.eye(2)
        found = np.linalg.solve(normal, (design * weight[:, None]).T @ half[used] + WEAK)
    # A difference has the noise of two pixels, and each pixel is in two of them.
    return float(found[0]), float(found[1]), np.asarray(3 * normal.shape[0] / 2 / free * np.linalg.inv(normal))
