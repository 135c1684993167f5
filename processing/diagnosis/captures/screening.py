"""Before anything is fitted: what of a capture is no measurement is found, left out, and reported.

An image that moves by a fraction of a pixel changes a sharp edge by more than can be undone: an edge narrower than the
pixels cannot be interpolated, and the spline rings for some pixels around it. What is lost there shows when an image is
moved by half a pixel and back. A steep slope that is smooth loses nothing: it shows a shift best.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import ndimage

from processing.arrays import Array
from processing.computing.filters import separable
from processing.diagnosis.captures.binning import averaged_for_fits
from processing.diagnosis.captures.capture_data import CaptureData, LeftOut
from processing.diagnosis.captures.noise import checked_noise
from processing.diagnosis.captures.outliers import bad_frames, outliers_of, remove_outliers
from processing.diagnosis.captures.read_capture import without_dark_pixels
from processing.diagnosis.captures.unstated_noise import estimated_noise
from processing.instrument.applied_effects import changes_of
from processing.instrument.model import InstrumentModel
from processing.reduction.move_image import taps

#: [standard deviations of one intensity] By which a pixel is another one after the image was moved by half a pixel and
#: back, from which on it is at an edge: what an image that moves does there cannot be undone.
LOST_BY_MOVING = 0.35
#: [of the pixels] Near an edge that are left out at most; where the image is all edges the flattest pixels are kept.
MOST_STEEP = 0.75

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
    change = _round_trip(0.5 / data.binned)
    change[FELT_PX] -= 1
    frames = data.signal.reshape(-1, *data.signal.shape[2:])
    slope, floor = (np.repeat(x, data.signal.shape[1]) for x in (data.slope, data.floor))
    total, alone = np.zeros(frames.shape[1:]), np.ones(1)
    for image, s, f in zip(frames, slope, floor, strict=True):
        square = sum(
            separable(image, across, down, "reflect") ** 2 for across, down in ((change, alone), (alone, change))
        )
        total += square / (s * np.maximum(image, 0) + f)
    return np.asarray(total / len(frames) - 2 * np.sum(change**2))


def _round_trip(shift_px: float) -> Array:
    """Weights of 2 `FELT_PX` + 1 neighbours along one axis."""
    kernel = np.convolve(taps(shift_px), taps(-shift_px))
    middle = kernel.size // 2
    near = kernel[middle - FELT_PX : middle + FELT_PX + 1]
    return np.asarray(near / near.sum())


def screen_capture(data: CaptureData, model: InstrumentModel, say: Callable[[str], None]) -> CaptureData:
    """The capture without hits, bad pixels, bad frames and sharp edges, and with the noise that it shows.

    `model` is resolved at its wavelength.
    """
    a = data.rows_of(model, changes_of(model, data.conditions, data.name))
    is_hit, is_bad = outliers_of(data, a)
    hits, bad = np.argwhere(is_hit), np.argwhere(is_bad)
    if len(hits) or len(bad):
        data = remove_outliers(data, is_hit | is_bad)
        # What was struck is no noise either.
        data = estimated_noise(data) if data.noise_estimated else data
        data = replace(data, left_out=LeftOut(hits=hits, pixels=bad, pitch=data.pitch))
        say(f"left out of {data.name}: {len(hits)} hits, {len(bad)} bad pixels")
    frames = bad_frames(data, a)
    if frames:
        misfits = {f.state: f.misfit for f in frames}
        exchanged = tuple(f.state for f in frames if f.instead is not None)
        data = replace(data, left_out=replace(data.left_out, frames=misfits, exchanged=exchanged))
        why = "each in the other's place" if exchanged else "which belongs to nothing"
        say(f"left out of {data.name}: state {', '.join(map(str, misfits))}, {why}")
    # After the hits, which are steep as well.
    data = checked_noise(without_steep_pixels(data) if data.noise_known else data, a)
    for line in data.told_of_noise:
        say(f"the noise of {data.name} is not what is declared: {line}")
    return _average_for_fit(data, say)


def _average_for_fit(data: CaptureData, say: Callable[[str], None]) -> CaptureData:
    """The capture, or means over squares of its pixels, without those that are dark or at sharp edges."""
    # Edges are left out of the fits, not of the means.
    with_edges = data if data.steep is None else replace(data, usable=data.usable | data.steep)
    fitted = averaged_for_fits(with_edges)
    if fitted is with_edges:
        return data
    say(f"{data.name} is fitted by means over squares of {fitted.binned} x {fitted.binned} pixels")
    if not data.noise_known:
        return fitted
    # Again: rims are as wide as the derivatives of the image reach.
    dark = without_dark_pixels(fitted)
    return without_steep_pixels(replace(dark, dark_fraction=max(dark.dark_fraction, data.dark_fraction)))
