"""Each 2 x 2 super-pixel becomes one pixel: half the size, no interpolation."""

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.reduction.mosaic.layout import MosaicLayout

REACH = 1
LINEAR = True


def channels(frame: Image, layout: MosaicLayout) -> NDArray[np.float32]:
    """Images (channels, rows/2, columns/2)."""
    return np.stack([layout.samples(frame, k) for k in range(len(layout.channels))]).astype(np.float32)
