"""Pseudo-panchromatic image difference (PPID), linear form.

The mean of all four channels around a pixel is known at full resolution; only each channel's difference from it is
interpolated. Source: Mihoubi, Lapray, Bigué, Sensors 18, 3688 (2018).
"""

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.computing.filters import separable
from processing.reduction.mosaic.filling import TENT, fill
from processing.reduction.mosaic.layout import MosaicLayout

REACH = 2
LINEAR = True

#: Mean of the four channels around each pixel, each with the same weight.
PANCHROMATIC = np.array([0.25, 0.5, 0.25], np.float32)


def channels(frame: Image, layout: MosaicLayout) -> NDArray[np.float32]:
    """Images (channels, rows, columns)."""
    mean = separable(frame, PANCHROMATIC, PANCHROMATIC)
    out = fill(frame - mean, layout, TENT)
    out += mean
    return out
