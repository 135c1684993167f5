"""Mean of the nearest two or four samples of the channel."""

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.reduction.mosaic.filling import TENT, fill
from processing.reduction.mosaic.layout import MosaicLayout

REACH = 1
LINEAR = True


def channels(frame: Image, layout: MosaicLayout) -> NDArray[np.float32]:
    """Images (channels, rows, columns)."""
    return fill(frame, layout, TENT)
