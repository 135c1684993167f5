"""Filters of images: by OpenCV where it is installed, which is several times as fast, else by scipy."""

from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array

try:
    import cv2
except ImportError:
    cv2 = None  # type: ignore[assignment]

#: How an image goes on beyond its edge: mirrored about the last pixel, which keeps the parity of a mosaic, or about the
#: edge of it.
Edge = Literal["mirror", "reflect"]


def separable(image: NDArray[Any], across: NDArray[Any], down: NDArray[Any], edge: Edge = "mirror") -> NDArray[Any]:
    """Image (rows, columns), float32 or float64, weighted with one kernel along its rows and one along its columns."""
    if cv2 is not None:
        border = cv2.BORDER_REFLECT_101 if edge == "mirror" else cv2.BORDER_REFLECT
        return np.asarray(cv2.sepFilter2D(image, -1, across, down, borderType=border))
    from scipy import ndimage

    rows = ndimage.correlate1d(image, across, axis=1, mode=edge)
    return np.asarray(ndimage.correlate1d(rows, down, axis=0, mode=edge))


def gaussian(image: NDArray[Any], sigma_px: float) -> NDArray[Any]:
    """Image smoothed by a Gaussian, which is cut at four standard deviations."""
    kernel = _gaussian(sigma_px)
    return separable(image, kernel, kernel)


@lru_cache(maxsize=8)
def _gaussian(sigma_px: float) -> Array:
    reach = round(4 * sigma_px)
    weights = np.exp(-((np.arange(-reach, reach + 1) / sigma_px) ** 2) / 2)
    return np.asarray(weights / weights.sum())


def box(image: NDArray[Any], side_px: int) -> NDArray[Any]:
    """Mean over the square around each pixel; the side is odd."""
    if cv2 is not None:
        return np.asarray(cv2.blur(image, (side_px, side_px), borderType=cv2.BORDER_REFLECT))
    from scipy import ndimage

    return np.asarray(ndimage.uniform_filter(image, side_px, mode="reflect"))


def block_means(image: NDArray[Any], rows: int, columns: int) -> Array:
    """Means (rows, columns) of equal parts of an image, whose pixels count by how much of them lies in a part."""
    by_row, by_column = (_shares(*sizes) for sizes in zip(image.shape, (rows, columns), strict=True))
    return np.asarray(by_row @ image.astype(np.float32) @ by_column.T, dtype=float)


@lru_cache(maxsize=8)
def _shares(pixels: int, parts: int) -> NDArray[np.float32]:
    """Weights (parts, pixels) of means."""
    edge, pixel = np.arange(parts + 1) * pixels / parts, np.arange(pixels)
    covered = np.minimum(edge[1:, None], pixel + 1) - np.maximum(edge[:-1, None], pixel)
    return np.asarray(np.maximum(covered, 0) * parts / pixels, dtype=np.float32)
