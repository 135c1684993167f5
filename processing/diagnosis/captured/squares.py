"""Squares of pixels, and means over them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def side_for(values: int, most: int) -> int:
    """Side of the squares of pixels that so many values are averaged over, so that at most `most` are left."""
    return max(int(np.ceil(np.sqrt(values / most))), 1)


def squares(image: NDArray[np.generic], side: int) -> NDArray[np.generic]:
    """Images (..., rows, columns) as (..., rows, side, columns, side); what is left over at the edges goes."""
    height, width = image.shape[-2] // side, image.shape[-1] // side
    whole = image[..., : height * side, : width * side]
    return whole.reshape(*image.shape[:-2], height, side, width, side)


def means(images: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Means (..., rows, columns) of images over squares of pixels."""
    if side == 1:
        return images
    return np.asarray(squares(images, side).mean(axis=(-3, -1), dtype=np.float64), dtype=np.float32)
