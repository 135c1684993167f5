"""Demosaicing: from one mosaic frame to an image for each channel.

Every method maps a float32 frame (rows, columns) to (channels, rows, columns), whatever the bit depth it came
from; `superpixel` gives half the size. docs/mosaic.md compares them on scenes with a known truth.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.reduction.mosaic import oriented as lmmse
from processing.reduction.mosaic.layout import MosaicError, MosaicLayout

#: 1D kernels that fill the gaps between samples two pixels apart: tent, and cubic convolution (a = -1/2).
TENT = np.array([0.5, 1.0, 0.5], np.float32)
CUBIC = np.array([-1 / 16, 0, 9 / 16, 1, 9 / 16, 0, -1 / 16], np.float32)

#: Mean of the four channels around each pixel, each with the same weight.
PANCHROMATIC = np.array([0.25, 0.5, 0.25], np.float32)

#: Guided filter: window radius in pixels, and the contrast, as a part of the mean level, that counts as an edge.
GUIDE_RADIUS = 3
GUIDE_CONTRAST = 0.03

# Reflection about the border pixel keeps the parity of the mosaic.
_BORDER = cv2.BORDER_REFLECT_101

#: Frame (rows, columns) to an image of each channel, (channels, rows, columns).
Method = Callable[[Image, MosaicLayout], NDArray[np.float32]]


def superpixel(frame: Image, layout: MosaicLayout) -> NDArray[np.float32]:
    """Each 2 x 2 super-pixel becomes one pixel: (channels, rows/2, columns/2), no interpolation."""
    return np.stack([layout.samples(frame, k) for k in range(len(layout.channels))]).astype(np.float32)


def bilinear(frame: Image, layout: MosaicLayout) -> NDArray[np.float32]:
    """Mean of the nearest two or four samples of the channel."""
    return _fill(frame, layout, TENT)


def bicubic(frame: Image, layout: MosaicLayout) -> NDArray[np.float32]:
    """Cubic convolution of the channel's samples."""
    return _fill(frame, layout, CUBIC)


def difference(frame: Image, layout: MosaicLayout) -> NDArray[np.float32]:
    """Pseudo-panchromatic image difference (PPID; Mihoubi, Lapray, Bigué, Sensors 18, 3688, 2018), linear form.

    The mean of all four channels around a pixel is known at full resolution; only each channel's difference
    from it is interpolated.
    """
    mean = cv2.sepFilter2D(frame, -1, PANCHROMATIC, PANCHROMATIC, borderType=_BORDER)
    out = _fill(frame - mean, layout, TENT)
    out += mean
    return out


def guided_residual(frame: Image, layout: MosaicLayout) -> NDArray[np.float32]:
    """Residual interpolation: a guided filter predicts each channel from the mean of all, the rest is interpolated.

    The guided filter is opencv-contrib's (`cv2.ximgproc.guidedFilter`), its source the bilinear channel.
    """
    guide = difference(frame, layout).mean(axis=0)
    epsilon = max((GUIDE_CONTRAST * float(np.abs(guide).mean())) ** 2, 1e-20)
    out = np.empty((len(layout.channels), *frame.shape), np.float32)
    for k, channel in enumerate(bilinear(frame, layout)):
        out[k] = cv2.ximgproc.guidedFilter(guide, channel, GUIDE_RADIUS, epsilon)
        rest = layout.sparse(frame - out[k], k)
        out[k] += cv2.sepFilter2D(rest, -1, TENT, TENT, borderType=_BORDER)
    return out


#: Pixels from which a value is taken lie within this distance; next to an edge of the scene they mix both sides.
REACH = {
    "superpixel": 1,
    "bilinear": 1,
    "bicubic": 3,
    "difference": 2,
    "guided-residual": 2 * GUIDE_RADIUS + 2,
    "oriented": lmmse.REACH,
}

METHODS: dict[str, Method] = {
    "superpixel": superpixel,
    "bilinear": bilinear,
    "bicubic": bicubic,
    "difference": difference,
    "guided-residual": guided_residual,
    "oriented": lmmse.oriented,
}


def demosaic(frame: NDArray[np.generic], layout: MosaicLayout, method: str) -> NDArray[np.float32]:
    """Channels of one mosaic frame by a named method.

    Parameters
    ----------
    frame : (rows, columns), integers of any depth or floating.
    method : a key of METHODS.

    Raises
    ------
    MosaicError : unknown method, or a frame that does not hold whole super-pixels.
    """
    if method not in METHODS:
        raise MosaicError(f"demosaicing method {method!r} is none of {', '.join(METHODS)}")
    layout.check((frame.shape[0], frame.shape[1]))
    return METHODS[method](np.ascontiguousarray(frame, dtype=np.float32), layout)


def _fill(frame: Image, layout: MosaicLayout, kernel: NDArray[np.float32]) -> NDArray[np.float32]:
    channels = range(len(layout.channels))
    return np.stack(
        [cv2.sepFilter2D(layout.sparse(frame, k), -1, kernel, kernel, borderType=_BORDER) for k in channels]
    )
