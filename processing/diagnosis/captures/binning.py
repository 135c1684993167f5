"""Means over squares of pixels, for fits to a capture with far more pixels than they need.

Pixels next to each other say the same of an instrument: a mean over them keeps what they know, error bars included, and
takes a fraction of the time. What needs pixels one by one (hits, bad pixels, the noise of the detector) comes before.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from processing.diagnosis.captures.capture_data import CaptureData, SharedNoise, mixed_part

#: [intensities] Of a capture that are fitted; more are averaged over squares of pixels.
MOST_FITTED = 5_000_000


def side_for(values: int, most: int) -> int:
    """Side of the squares of pixels that so many values are averaged over, so that at most `most` are left."""
    return max(int(np.ceil(np.sqrt(values / most))), 1)


def squares(image: NDArray[np.generic], side: int) -> NDArray[np.generic]:
    """Images (..., rows, columns) as (..., rows, side, columns, side); what is left over at the edges goes."""
    height, width = image.shape[-2] // side, image.shape[-1] // side
    crop = image[..., : height * side, : width * side]
    return crop.reshape(*image.shape[:-2], height, side, width, side)


def means(images: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Means (..., rows, columns) of images over squares of pixels."""
    if side == 1:
        return images
    return np.asarray(squares(images, side).mean(axis=(-3, -1), dtype=np.float64), dtype=np.float32)


def averaged_for_fits(data: CaptureData) -> CaptureData:
    """The capture as it is fitted: itself, or means over as small squares of pixels as leave few enough values."""
    side = side_for(data.signal.size, MOST_FITTED)
    return averaged(data, side) if side > 1 else data


def averaged(data: CaptureData, side: int) -> CaptureData:
    """Means over squares of so many pixels a side, of a capture of which nothing was undone or moved back yet.

    A square counts if all of its pixels do, and is clipped if one of them is. Its neighbours share less noise than
    those of pixels do, lines more.
    """
    shared = data.shared
    right, down = (mixed_part(part * (1 - part) / side) for part in (shared.right, shared.down))
    return replace(
        data,
        signal=means(data.signal, side),
        slope=data.slope / side**2,
        floor=data.floor / side**2,
        shared=SharedNoise(right, down, shared.rows * side, shared.columns * side),
        clipped=_any(data.clipped, side),
        usable=~_any(~data.usable, side),
        steep=None if data.steep is None else _any(data.steep, side),
        binned=data.binned * side,
        pitch=data.pitch * side,
    )


def _any(mask: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    return np.asarray(squares(mask, side).any(axis=(-3, -1)))
