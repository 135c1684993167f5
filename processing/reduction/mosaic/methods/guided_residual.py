"""Residual interpolation: a guided filter predicts each channel from the mean of all, the rest is interpolated.

The guided filter is opencv-contrib's (`cv2.ximgproc.guidedFilter`), its source the bilinear channel.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.reduction.mosaic.filling import BORDER, TENT, fill
from processing.reduction.mosaic.layout import MosaicLayout
from processing.reduction.mosaic.methods import difference

#: Guided filter: window radius in pixels, and the contrast, as a part of the mean level, that counts as an edge.
GUIDE_RADIUS = 3
GUIDE_CONTRAST = 0.03

REACH = 2 * GUIDE_RADIUS + 2


def channels(frame: Image, layout: MosaicLayout) -> NDArray[np.float32]:
    """Images (channels, rows, columns)."""
    guide = difference.channels(frame, layout).mean(axis=0)
    epsilon = max((GUIDE_CONTRAST * float(np.abs(guide).mean())) ** 2, 1e-20)
    out = np.empty((len(layout.channels), *frame.shape), np.float32)
    for k, channel in enumerate(fill(frame, layout, TENT)):
        out[k] = cv2.ximgproc.guidedFilter(guide, channel, GUIDE_RADIUS, epsilon)
        rest = layout.sparse(frame - out[k], k)
        out[k] += cv2.sepFilter2D(rest, -1, TENT, TENT, borderType=BORDER)
    return out
