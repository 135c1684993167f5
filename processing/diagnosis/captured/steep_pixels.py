"""Pixels at sharp edges, which an image that moves by a fraction of a pixel changes by more than can be undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.search.rules import EDGE_RIM, MOST_STEEP, STEEPEST


def without_steep_pixels(data: CaptureData) -> CaptureData:
    """The capture without pixels near sharp edges, root mean square over the frames."""
    if data.conditions.states < 2 or min(data.signal.shape[2:]) < 3:
        return data
    square = _squared_slopes(data)
    return _without(data, square > STEEPEST**2, square, EDGE_RIM)


def without_steep_squares(data: CaptureData) -> CaptureData:
    """Means over squares of pixels without those near `steep` ones, where it counts how sharp the pixels saw an edge.

    A mean of many pixels has less noise, in which a slope that can be undone would be an edge.
    """
    if data.steep is None:
        return data
    # The pixels of the rim are among the steep ones.
    return _without(data, data.steep, _squared_slopes(data), EDGE_RIM - EDGE_RIM // data.binned)


def _squared_slopes(data: CaptureData) -> Array:
    """Squared slope (rows, columns) over a pixel of the sensor in standard deviations of one, mean over the frames."""
    square = np.zeros(data.signal.shape[2:])
    frames = data.signal.reshape(-1, *data.signal.shape[2:])
    floor = np.repeat(data.floor, data.signal.shape[1])
    slope = np.repeat(data.slope, data.signal.shape[1])
    for image, s, f in zip(frames, slope, floor, strict=True):
        down, across = np.gradient(image)
        square += (down**2 + across**2) / (s * np.maximum(image, 0) + f)
    return square / len(frames) / data.binned**4


def _without(data: CaptureData, edge: NDArray[np.bool_], square: Array, rim: int) -> CaptureData:
    """The capture without edges and the pixels of a rim around; of an image that is all edge, with the flattest."""
    wide = ndimage.binary_dilation(data.usable & edge, structure=np.ones((3, 3), dtype=bool), iterations=rim)
    steep = data.usable & wide
    if steep.sum() > MOST_STEEP * data.usable.sum():
        steep = _all_but_the_flattest(square, data.usable)
    return replace(data, usable=data.usable & ~steep, steep=steep)


def _all_but_the_flattest(square: Array, usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (H, W) to leave out of an image that is all edge, by the squared slope of their surroundings."""
    around = ndimage.maximum_filter(square, size=3)
    # None where all are equally steep: there is nothing else to look at.
    return usable & (around > np.quantile(around[usable], 1 - MOST_STEEP))
