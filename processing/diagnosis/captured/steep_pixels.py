"""Pixels at sharp edges, which an image that moves by a fraction of a pixel changes by more than can be undone.

An edge that is narrower than the pixels resolve cannot be interpolated, and the spline rings for some pixels around it.
What is lost there shows when an image is moved by half a pixel and back. A steep slope that is smooth loses nothing: a
shift is seen best on it.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from scipy import ndimage

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.search.rules import LOST_BY_MOVING, MOST_STEEP, TRIED_PX
from processing.reduction.move_image import taps

#: [pixels, or squares of them] From which on nothing of an edge is felt.
FELT_PX = 8


def without_steep_pixels(data: CaptureData) -> CaptureData:
    """The capture without pixels that are others after the image was moved by half a pixel and back."""
    if data.conditions.states < 2 or min(data.signal.shape[2:]) < 3:
        return data
    lost = _lost_by_moving(data)
    edge = lost > LOST_BY_MOVING**2
    # In the very middle of an edge what is lost goes through zero.
    edge |= ndimage.binary_closing(edge, structure=np.ones((3, 3), dtype=bool))
    steep = data.usable & edge
    if steep.sum() > MOST_STEEP * data.usable.sum():
        # None where all are equally steep: there is nothing else to look at.
        steep = data.usable & (lost > np.quantile(lost[data.usable], 1 - MOST_STEEP))
    return replace(data, usable=data.usable & ~steep, steep=steep)


def _lost_by_moving(data: CaptureData) -> Array:
    """Squared change of each pixel (rows, columns), over its variance and beyond what noise gives; mean of frames."""
    change = _there_and_back(TRIED_PX / data.binned)
    change[FELT_PX] -= 1
    frames = data.signal.reshape(-1, *data.signal.shape[2:])
    slope, floor = (np.repeat(x, data.signal.shape[1]) for x in (data.slope, data.floor))
    total, alone = np.zeros(frames.shape[1:]), np.ones(1)
    for image, s, f in zip(frames, slope, floor, strict=True):
        square = sum(
            cv2.sepFilter2D(image, cv2.CV_32F, across, down, borderType=cv2.BORDER_REFLECT) ** 2
            for across, down in ((change, alone), (alone, change))
        )
        total += square / (s * np.maximum(image, 0) + f)
    return np.asarray(total / len(frames) - 2 * np.sum(change**2))


def _there_and_back(shift_px: float) -> Array:
    """Weights of 2 `FELT_PX` + 1 neighbours along one axis."""
    whole = np.convolve(taps(shift_px), taps(-shift_px))
    middle = whole.size // 2
    near = whole[middle - FELT_PX : middle + FELT_PX + 1]
    return np.asarray(near / near.sum())
