"""Cubic convolution (a = -1/2) of the channel's samples."""

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.reduction.mosaic.filling import fill
from processing.reduction.mosaic.layout import MosaicLayout

REACH = 3
LINEAR = True

CUBIC = np.array([-1 / 16, 0, 9 / 16, 1, 9 / 16, 0, -1 / 16], np.float32)


def channels(frame: Image, layout: MosaicLayout) -> NDArray[np.float32]:
    """Images (channels, rows, columns)."""
    return fill(frame, layout, CUBIC)
