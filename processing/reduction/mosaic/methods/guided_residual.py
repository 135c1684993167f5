"""Residual interpolation: a guided filter predicts each channel from the mean of all, the rest is interpolated.

Source: He, Sun, Tang, IEEE Trans. Pattern Anal. Mach. Intell. 35, 1397 (2013); it filters the bilinear channel.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.computing.filters import box, separable
from processing.reduction.mosaic.filling import TENT, fill
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
        out[k] = _guided(guide, channel, epsilon)
        rest = layout.sparse(frame - out[k], k)
        out[k] += separable(rest, TENT, TENT)
    return out


def _guided(guide: Image, channel: Image, epsilon: float) -> Image:
    """The channel as a linear function of the guide around each pixel, averaged over the windows that hold it."""

    def mean(image: NDArray[Any]) -> NDArray[Any]:
        return box(image, 2 * GUIDE_RADIUS + 1)

    middle, level = mean(guide), mean(channel)
    slope = (mean(guide * channel) - middle * level) / (mean(guide * guide) - middle * middle + np.float32(epsilon))
    return np.asarray(mean(slope) * guide + mean(level - slope * middle))
