"""What is left of a capture when what its pixels have in common is taken away: the model, and structure beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.search.range_of import inside_and_outside
from processing.diagnosis.search.rules import BEYOND_NOISE, CUT_BACK

#: [standard deviations, fixed] Median of absolute values of normal ones.
NORMAL_MAD = 0.6745
#: [pixels] That tell a standard deviation to half a percent.
PIXELS_OF_SCALE = 50_000
#: [of the largest] Least variance of a row in whose units it is: that of none is zero.
LEAST_LEVEL = 1e-3


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
        variance = data.variance_of(good).reshape(rows, -1)[keep].astype(np.float32)
        mean = np.mean(variance, axis=1, dtype=float)
        level = np.sqrt(np.maximum(mean, LEAST_LEVEL * mean.max()))
        y /= level[:, None].astype(np.float32)
        variance /= (level[:, None] ** 2).astype(np.float32)
        return cls(y, variance, level, *inside_and_outside(a[keep] / level[:, None]))

    def rest(self, clean: NDArray[np.bool_]) -> Array:
        """Projection (L, L) on what neither the model reaches nor the residual of the `clean` pixels has in common."""
        outside = self.outside.astype(np.float32)
        r = outside @ (outside.T @ (self.y if clean.all() else self.y[:, clean]))
        scale = robust_scale(r).astype(np.float32)
        inner = (outside.T @ np.clip(r, -CUT_BACK * scale, CUT_BACK * scale, out=r)).astype(float)
        value, vector = np.linalg.eigh(inner @ inner.T / inner.shape[1])
        # Largest eigenvalue of noise over the median one (Marchenko and Pastur).
        edge = BEYOND_NOISE * (1 + np.sqrt(len(value) / inner.shape[1])) ** 2
        # At least half of the directions are left to tell what noise is.
        half = len(value) // 2
        structure = self.outside @ vector[:, half:][:, value[half:] > edge * np.median(value)]
        return np.asarray(self.outside @ self.outside.T - structure @ structure.T)


def robust_scale(r: NDArray[np.floating]) -> Array:
    """Robust standard deviation (L, 1) of every row; of many pixels some tell it."""
    r = r[:, :: r.shape[1] // PIXELS_OF_SCALE + 1]
    return np.asarray(np.maximum(np.median(np.abs(r), axis=1, keepdims=True) / NORMAL_MAD, 1e-12))
