"""Variance of a bin's mean where the noise of neighbouring pixels is correlated, as demosaicing makes it."""

import numpy as np
from numpy.typing import NDArray

from processing.arrays import RealArray

#: Correlations below this are left out.
LEAST = 0.005


def shared_variance(
    bins: NDArray[np.integer], stderr: RealArray, correlation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Variance (rows, columns) of each pixel with its covariances with the other pixels of its bin.

    The mean over a bin of n pixels has the variance mean(found) / n, as if they were independent.

    Parameters
    ----------
    bins : (rows, columns), bin of each pixel; negative: not in a table.
    stderr : (rows, columns), standard error of each pixel; NaN: does not count.
    correlation : (2 R + 1, 2 R + 1), of two pixels by their distance in rows and columns, 1 at the centre.
    """
    sigma = np.where((bins >= 0) & np.isfinite(stderr), stderr, 0.0)
    variance = sigma**2
    reach = correlation.shape[0] // 2
    rows, columns = bins.shape
    for dy, dx in np.argwhere(np.abs(correlation) > LEAST) - reach:
        # Each pair once; it counts for both of its pixels.
        if (dy, dx) <= (0, 0) or dy >= rows or abs(dx) >= columns:
            continue
        first = np.s_[: rows - dy, max(0, -dx) : columns - max(0, dx)]
        second = np.s_[dy:, max(0, dx) : columns - max(0, -dx)]
        pair = np.where(
            bins[first] == bins[second], correlation[reach + dy, reach + dx] * sigma[first] * sigma[second], 0.0
        )
        variance[first] += pair
        variance[second] += pair
    return np.asarray(variance)
