"""Noise of a camera whose gain is not known, from the scatter over pixels that no linear model explains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import nnls

from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.search.rules import FEW_ROWS, LEAST_SCATTER

#: [components, fixed] Of the states that count as signal: a Mueller matrix has 16 unknowns.
COMPONENTS = 16
#: [pixels] That are looked at.
PIXELS = 20_000
#: [of the mean variance] Least variance without light.
LEAST_FLOOR = 0.01
#: [digits] Of the range of the signal, to which two signals are the same.
DIGITS = 9
#: [levels] Of the signal at which their scatter is told.
LEVELS = 24


def estimated_noise(data: CaptureData) -> CaptureData:
    """The capture with variance = slope * signal + floor as its own pixels show it.

    The leading components over all pixels are taken away from each pixel (16 at most, so an unknown sample and any
    instrument error that is linear in it are gone); what is left, binned over the signal, gives the line. Structure
    over the image that is left as well makes the estimate too large, never too small.
    """
    picked = np.flatnonzero((data.usable & ~data.clipped).reshape(-1))
    if picked.size > PIXELS:
        picked = picked[:: picked.size // PIXELS + 1]
    y = data.signal.reshape(data.values_per_pixel, -1)[:, picked].astype(np.float64)
    rows = y.shape[0]
    keep = min(COMPONENTS, rows - 1, max(picked.size // 4, 1)) if data.sample is None else min(2, rows - 1)
    u, _, _ = np.linalg.svd(y @ y.T)
    rest = y - u[:, :keep] @ (u[:, :keep].T @ y)
    # A row that the components follow closely has less scatter left than its noise.
    share = 1 - np.sum(u[:, :keep] ** 2, axis=1)
    good = share > LEAST_SCATTER if rows > FEW_ROWS else share > 0.0
    square = rest[good] ** 2 / share[good, None]
    signal = (y - rest)[good]
    # Signals that rounding alone sets apart share a level, or it would hang on the processor's order of sums.
    alike = np.round(signal / max(float(np.ptp(signal)), 1e-300), DIGITS)
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
    floor = max(floor, LEAST_FLOOR * float(np.mean(square)), 1e-12)
    # Weighted as it will be used, the scatter must come out as one.
    correction = float(np.mean(square / (slope * np.maximum(signal, 0) + floor)))
    slope, floor = slope * correction, floor * correction
    n = data.signal.shape[0]
    return replace(
        data,
        slope=np.full(n, slope),
        floor=np.full(n, floor),
        noise_known=True,
        noise_estimated=True,
        noise_source="estimated from the scatter over pixels that is left after the leading components of the states",
    )
