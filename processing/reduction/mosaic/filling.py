"""Fills the gaps between the samples of one channel of a mosaic."""

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.computing.filters import separable
from processing.reduction.mosaic.layout import MosaicLayout

#: 1D kernel that fills the gaps between samples two pixels apart.
TENT = np.array([0.5, 1.0, 0.5], np.float32)


def fill(frame: Image, layout: MosaicLayout, kernel: NDArray[np.float32]) -> NDArray[np.float32]:
    """Images (channels, rows, columns): each channel's samples convolved with a 1D kernel along both axes."""
    channels = range(len(layout.channels))
    return np.stack([separable(layout.sparse(frame, k), kernel, kernel) for k in channels])
