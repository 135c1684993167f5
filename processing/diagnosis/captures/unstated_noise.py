"""The noise of a capture that does not state it, from the scatter of its own pixels."""

from dataclasses import replace

import numpy as np
from scipy.optimize import nnls

from processing.arrays import Array
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.search.range_of import NEARLY_ZERO
from processing.diagnosis.search.rules import ENOUGH_PX, FEWEST_FREE, LITTLE, SMALL

#: [levels] Of the signal at which their scatter is told.
LEVELS = 24


def estimated_noise(data: CaptureData) -> CaptureData:
    """The capture with variance = slope * signal + floor as its own pixels show it.

    The leading components over all pixels are taken away from each pixel (16 at most, so an unknown sample and any
    instrument error that is linear in it are gone); what is left, binned over the signal, gives the line. Structure
    over the image that is left as well makes the estimate too large, never too small.
    """
    picked = np.flatnonzero((data.usable & ~data.clipped).reshape(-1))
    picked = picked[:: picked.size // ENOUGH_PX + 1]
    y = data.signal.reshape(data.values_per_pixel, -1)[:, picked].astype(np.float64)
    most = 16 if data.sample is None else 2
    even = np.ones((len(y), 1))
    slope, floor = _line_of_scatter(y, even, even[:1], min(most, len(y) - 1, max(picked.size // 4, 1)))
    # In units of that noise, as it is by rows and by pixels, components that are no larger than noise show; they would
    # take away the noise of the brightest.
    variance = slope * np.maximum(y, 0) + floor
    of_row, of_pixel = (np.sqrt(variance.mean(axis=axis, keepdims=True)) for axis in (1, 0))
    of_pixel /= np.sqrt(variance.mean())
    z = y / of_row / of_pixel
    size = np.linalg.eigvalsh(z @ z.T) / picked.size
    keep = int(np.sum(size > (1 + np.sqrt(len(y) / picked.size)) ** 2))
    slope, floor = _line_of_scatter(y, of_row, of_pixel, min(keep, most, len(y) - 1))
    n = data.signal.shape[0]
    return replace(
        data,
        slope=np.full(n, slope),
        floor=np.full(n, floor),
        noise_known=True,
        noise_estimated=True,
        noise_source="estimated from the scatter over pixels that is left after the leading components of the states",
    )


def _line_of_scatter(y: Array, of_row: Array, of_pixel: Array, keep: int) -> tuple[float, float]:
    """Slope and floor of the scatter of y (L, P) that `keep` components leave of it, over (L, 1) and (1, P)."""
    z = y / of_row / of_pixel
    u, size, _ = np.linalg.svd(z @ z.T)
    along, u = (u[:, :keep].T @ z) ** 2 / size[:keep, None], u[:, :keep]
    outside = of_row * (np.eye(len(y)) - u @ u.T) / of_row.T
    residual = outside @ y
    # What is left of one row has noise of the others. Rows and pixels that the components follow closely have less.
    of_noise = outside**2
    share = of_noise.sum(axis=1, keepdims=True)
    # Of few rows every one that has any noise tells it: there are no others.
    good = (share > (SMALL if len(y) > FEWEST_FREE else 0.0))[:, 0]
    square = residual[good] ** 2 / share[good] / np.maximum(1 - along.sum(axis=0), SMALL)
    signal = ((of_noise / share) @ np.maximum(y - residual, 0))[good]
    # Signals that rounding alone sets apart share a level, or it would hang on the processor's order of sums.
    alike = np.round(signal / max(NEARLY_ZERO * float(np.ptp(signal)), 1e-300))
    edges = np.quantile(alike, np.linspace(0, 1, LEVELS + 1))
    level = np.clip(np.searchsorted(edges, alike, side="right") - 1, 0, LEVELS - 1)
    count = np.bincount(level.reshape(-1), minlength=LEVELS)
    mean = np.bincount(level.reshape(-1), signal.reshape(-1), LEVELS) / np.maximum(count, 1)
    variance = np.bincount(level.reshape(-1), square.reshape(-1), LEVELS) / np.maximum(count, 1)
    weight = np.sqrt(count) / np.maximum(variance, 1e-12)
    (slope, floor), _ = nnls(
        np.stack([np.maximum(mean, 0), np.ones(LEVELS)], axis=1) * weight[:, None], variance * weight
    )
    # Counts of zero have a noise all the same: where the line leads to none, they would weigh as much as they like.
    floor = max(floor, LITTLE * float(np.mean(square)), 1e-12)
    # Weighted as it will be used, the scatter must come out as one.
    correction = float(np.mean(square / (slope * np.maximum(signal, 0) + floor)))
    return slope * correction, floor * correction
