"""Pixels at sharp edges, which an image that moves by a fraction of a pixel changes by more than can be undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from processing.diagnosis.captured.capture_data import CaptureData

#: Slope of the image, in standard deviations of an intensity for each pixel of way, from which on a pixel is left out.
#: A frame that moved by a quarter of a pixel, an ordinary support, is moved back to a tenth of that.
STEEPEST = 6.0
#: With more than this share of the pixels steep the image is all edges, and they are kept.
MOST_STEEP = 0.5


def without_steep_pixels(data: CaptureData) -> CaptureData:
    """The capture without pixels at sharp edges, root mean square over the frames."""
    if min(data.signal.shape[2:]) < 3:
        return data
    square = np.zeros(data.signal.shape[2:])
    frames = data.signal.reshape(-1, *data.signal.shape[2:])
    floor = np.repeat(data.floor, data.signal.shape[1])
    slope = np.repeat(data.slope, data.signal.shape[1])
    for image, s, f in zip(frames, slope, floor, strict=True):
        down, across = np.gradient(image)
        square += (down**2 + across**2) / (s * np.maximum(image, 0) + f)
    steep = data.usable & (square > STEEPEST**2 * len(frames))
    if steep.sum() > MOST_STEEP * data.usable.sum():
        return data
    return replace(data, usable=data.usable & ~steep, steep_fraction=float(steep.mean()))
