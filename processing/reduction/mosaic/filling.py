"""Fills the gaps between the samples of one channel of a mosaic."""

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.reduction.mosaic.layout import MosaicLayout

#: 1D kernel that fills the gaps between samples two pixels apart.
TENT = np.array([0.5, 1.0, 0.5], np.float32)
#: Reflection about the border pixel keeps the parity of the mosaic.
BORDER = cv2.BORDER_REFLECT_101


def fill(frame: Image, layout: MosaicLayout, kernel: NDArray[np.float32]) -> NDArray[np.float32]:
    """Images (channels, rows, columns): each channel's samples convolved with a 1D kernel along both axes."""
    channels = range(len(layout.channels))
    return np.stack([cv2.sepFilter2D(layout.sparse(frame, k), -1, kernel, kernel, borderType=BORDER) for k in channels])
