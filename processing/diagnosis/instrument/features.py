"""Features of the counts of a pixel, in which corrections of the counts are linear, and the noise they have in common.

Powers and logarithms need the pixel alone, derivatives of the image the pixels around it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.filters import separable
from processing.diagnosis.captures.capture_data import SharedNoise
from processing.diagnosis.search.rules import KEPT
from processing.instrument.changes import STRAIGHT_BELOW
from processing.reduction.move_image import noise_taps

#: Features of a signal u (counts over full scale); corrected counts = u + sum of coefficient times feature.
FEATURES = (
    *("counts", "one", "square", "cube", "fourth", "log", "log_square", "log_cube", "right", "down"),
    *("dx", "dy", "dxx", "dxy", "dyy"),
)
NOTHING_SHARED = SharedNoise()
#: [pixels, fixed] On either side that the filters take in, and at the rim that they do not reach.
MARGIN = 3
#: Savitzky-Golay filters: value (third order), first and second derivative (fourth and fifth order).
FILTERS = tuple(
    np.linalg.pinv(np.vander(np.arange(-MARGIN, MARGIN + 1.0), k + 4, increasing=True))[k] * max(k, 1) for k in range(3)
)
#: [1, fixed] Order of each derivative down and across the image, as they stand in FEATURES, of which they are the last.
ORDERS = ((0, 1), (1, 0), (0, 2), (1, 1), (2, 0))
DERIVATIVES = len(ORDERS)
#: Filters down and across the image of a pixel itself and of its derivatives.
PATTERNS = ((np.eye(2 * MARGIN + 1)[MARGIN],) * 2, *((FILTERS[down], FILTERS[across]) for down, across in ORDERS))


def features(u: NDArray[np.floating[Any]], x: Array, y: Array) -> tuple[NDArray[Any], NDArray[Any]]:
    """Features of signals that need no neighbours, (F - 5, ...), and their derivatives by the signal, as exact as u.

    Of signals at x and y (...), from -1 to 1 to the right and down.
    """
    z, slope = np.empty((2, len(FEATURES) - DERIVATIVES, *u.shape), dtype=u.dtype)
    # Products: numpy's powers beyond the second take ten times as long.
    log, square = np.log(np.maximum(u, STRAIGHT_BELOW)), u * u
    cube, log_square = square * u, log * log
    # Straight below: there the logarithm is constant.
    curved = (u > STRAIGHT_BELOW).astype(u.dtype)
    z[0], slope[0] = u, 1.0
    z[1], slope[1] = 1.0, 0.0
    z[2], slope[2] = square, 2 * u
    z[3], slope[3] = cube, 3 * square
    z[4], slope[4] = square * square, 4 * cube
    z[5], slope[5] = u * log, log + curved
    z[6], slope[6] = u * log_square, log_square + 2 * log * curved
    z[8], slope[8] = u * x, x
    z[9], slope[9] = u * y, y
    z[7], slope[7] = u * log_square * log, log_square * log + 3 * log_square * curved
    return z, slope


def derivatives_known(height: int, width: int) -> bool:
    """Whether an image is large enough for its derivatives; they are zero in a smaller one."""
    return min(height, width) > 2 * MARGIN + 2


def inside(height: int, width: int) -> NDArray[np.bool_]:
    """Pixels whose derivatives need nothing beyond the edge; all of them where the image is too small for that."""
    mask = np.ones((height, width), dtype=bool)
    if derivatives_known(height, width):
        mask[:MARGIN], mask[-MARGIN:], mask[:, :MARGIN], mask[:, -MARGIN:] = False, False, False, False
    return mask


def derivatives_of_part(u: NDArray[np.floating], rows: slice, columns: slice) -> NDArray[np.float32]:
    """dx, dy, dxx, dxy, dyy (5, L, rows, columns) of a rectangle of images (L, ...); zero if these are too small."""
    height, width = rows.stop - rows.start, columns.stop - columns.start
    derivatives = np.zeros((DERIVATIVES, u.shape[0], height, width), dtype=np.float32)
    if not derivatives_known(*u.shape[1:]):
        return derivatives
    top, left = max(rows.start - MARGIN, 0), max(columns.start - MARGIN, 0)
    inner = slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left)
    for n, frame in enumerate(u[:, top : rows.stop + MARGIN, left : columns.stop + MARGIN]):
        for k, (down, right) in enumerate(ORDERS):
            derivatives[k, n] = separable(frame, FILTERS[right], FILTERS[down])[inner]
    return derivatives


# Frames that did not move, or moved together, share one answer.
@lru_cache(maxsize=KEPT)
def shared_noise(x_px: float, y_px: float, mixed: SharedNoise = NOTHING_SHARED) -> Array:
    """Covariance (6, 6) of the noise of a pixel and its derivatives in a frame that was moved back by so many pixels.

    For unit noise of single pixels, which moving the frame, and what was `mixed` before, make alike among neighbours.
    """
    across = np.stack([np.convolve(kernel, noise_taps(x_px, mixed.right)) for _, kernel in PATTERNS])
    down = np.stack([np.convolve(kernel, noise_taps(y_px, mixed.down)) for kernel, _ in PATTERNS])
    covariance = np.asarray((across @ across.T) * (down @ down.T))
    covariance.flags.writeable = False
    return covariance


def feature_noise(slopes: NDArray[Any], share: NDArray[Any], shared: Array) -> Array:
    """Expected noise (L, F, F) of products of features, summed over pixels; neighbours count as noisy as the pixel.

    Of slopes (F - 5, L, P) of the features by the signal, variances `share` (L, P), and `shared_noise` (L, 6, 6).
    """
    plain = len(slopes)
    noise = np.zeros((share.shape[0], len(FEATURES), len(FEATURES)))
    by_row = slopes.transpose(1, 0, 2)
    noise[:, :plain, :plain] = (by_row * share[:, None]) @ by_row.transpose(0, 2, 1)
    cross = noise[:, :plain, 0].copy()
    noise[:, :plain, :plain] *= shared[:, :1, :1]
    cross = cross[:, :, None] * shared[:, :1, 1:]
    noise[:, :plain, plain:], noise[:, plain:, :plain] = cross, cross.transpose(0, 2, 1)
    noise[:, plain:, plain:] = share.sum(axis=1, dtype=float)[:, None, None] * shared[:, 1:, 1:]
    return noise
