"""Images moved by fractions of a pixel, by interpolation with a spline of fifth order, and without a slight blur."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from processing.computing.filters import separable

#: Pixels on either side that count; what the spline takes from further away is below 1e-4.
REACH = 10


def shifted_back(image: NDArray[np.floating], x_px: float, y_px: float, blur_px2: float = 0.0) -> NDArray[np.float32]:
    """Image (rows, columns) moved back by what it had moved to the right and down; slopes go on beyond its edges.

    A blur of this variance along each axis is taken off, to first order; where it is below zero, added.
    """
    sharper = np.array([-blur_px2 / 2, 1 + blur_px2, -blur_px2 / 2])
    along_x, along_y = (np.convolve(taps(shift), sharper) if blur_px2 else taps(shift) for shift in (x_px, y_px))
    x, y = along_x.size // 2, along_y.size // 2
    wide = np.pad(image.astype(np.float32), ((y, y), (x, x)), mode="reflect", reflect_type="odd")
    moved = separable(wide, along_x, along_y)
    return np.asarray(moved[y : y + image.shape[0], x : x + image.shape[1]], dtype=np.float32)


def taps(shift_px: float) -> NDArray[np.float64]:
    """Weights of neighbours along one axis, an odd number of them, that move an image back by so many pixels."""
    reach = REACH + math.ceil(abs(shift_px))
    impulse = np.zeros(2 * (reach + REACH) + 1)
    impulse[reach + REACH] = 1.0
    weights = ndimage.shift(impulse, shift_px, order=5, mode="mirror")[REACH:-REACH]
    return np.asarray(weights / weights.sum())


def noise_taps(shift_px: float, mixed: float = 0.0) -> NDArray[np.float64]:
    """Weights of independent noises in a pixel moved back so, `mixed` of the next having been in each before."""
    return np.convolve(taps(shift_px), [1 - mixed, mixed]) if mixed else taps(shift_px)


def neighbour_noise(x_px: float, y_px: float, right: float = 0.0, down: float = 0.0) -> tuple[float, float]:
    """Covariance of the noise of neighbours down and across an image moved back so, for unit noise before.

    `right`, `down` : part of the next pixel that each had in it already.
    """
    along_x, along_y = noise_taps(x_px, right), noise_taps(y_px, down)
    return (
        float(np.sum(along_y[1:] * along_y[:-1]) * np.sum(along_x**2)),
        float(np.sum(along_y**2) * np.sum(along_x[1:] * along_x[:-1])),
    )
