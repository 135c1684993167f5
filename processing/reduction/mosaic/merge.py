"""One mosaic frame out of alike states: black, flat, exposure, and what is saturated left out."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.instrument.changes import places
from processing.reduction.counts_to_signal import CountCorrection
from processing.reduction.effects_of_capture import CountsCorrection
from processing.reduction.measurement_matrix import relative_exposure
from processing.reduction.noise import NoiseModel
from processing.storage.captures.capture import Capture
from processing.storage.products.pixel_mask import Mask


@dataclass(frozen=True)
class MergedFrame:
    """Sum of the signals over the sum of the exposures of all states that a raw pixel can use.

    Attributes
    ----------
    signal : (rows, columns), counts above black at the longest exposure, flat divided.
    mask : (rows, columns), bits of Mask. A pixel is left out of every state of an exposure in one of which it
        saturates (choosing state by state would favour low counts); NOT_DETERMINED where no exposure is left.
    shot, floor, relative : variance of a raw pixel is shot * signal + floor + relative * signal^2, the last part being
        the error of the flat; each (rows, columns), or (1, 1) where all are alike. None: no flat.
    """

    signal: Image
    mask: NDArray[np.uint8]
    shot: Image
    floor: Image
    relative: Image | None = None


def merge(
    capture: Capture,
    states: NDArray[np.int64],
    correction: CountCorrection,
    noise: NoiseModel,
    *,
    counts: CountsCorrection | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> MergedFrame:
    """Merge the states of a mosaic capture, which differ in nothing but exposure.

    Parameters
    ----------
    counts : correction of the counts that the instrument's effects ask for, applied to each state.
    progress : called with (states done, states in all).
    """
    shape = capture.frame_shape
    exposure = capture.column("exposure_s")[states].astype(float)
    repeats = np.maximum(capture.column("repeats")[states].astype(float), 1)
    relative = relative_exposure(capture, states)
    weights = correction.black.weights(exposure)
    excess = correction.black.excess(noise, exposure)
    flat = None if correction.flat is None else correction.flat.response[0]
    total, mask = np.zeros(shape), np.zeros(shape, np.uint8)
    # One number each while nothing saturates; images as soon as pixels differ.
    zero: NDArray[np.floating] = np.zeros((1, 1), np.float32)
    weight = shot = floor = zero
    share: NDArray[np.floating] = np.zeros((weights.shape[1], 1, 1), np.float32)
    count = 0
    for value in np.unique(relative):
        group = np.flatnonzero(relative == value)
        light, clipped = np.zeros(shape), np.zeros(shape, bool)
        black = correction.black.at(exposure[group[0]])[0]
        for k in group:
            frame = capture.frames(int(states[k]))[0]
            if correction.saturation is not None:
                clipped |= frame >= correction.saturation
            if frame.dtype.kind == "f":
                mask[~np.isfinite(frame)] |= np.uint8(Mask.NOT_FINITE)
            light += _signal(frame, black, flat, counts)
            count += 1
            if progress:
                progress(count, len(states))
        mask[clipped] |= np.uint8(Mask.SATURATED)
        # What saturates even at the shortest exposure keeps a value for its neighbours, and is masked.
        if value == relative.min():
            mask[clipped] |= np.uint8(Mask.NOT_DETERMINED)
            clipped[:] = False
        keep = ~clipped if clipped.any() else np.ones((1, 1), bool)
        light *= keep
        total += light
        weight = weight + np.float32(value * len(group)) * keep
        shot = shot + np.float32(np.sum(value / repeats[group])) * keep
        floor = floor + np.float32(noise.averaged_floor(repeats[group], excess[group]).sum()) * keep
        share = share + weights[group].sum(axis=0).astype(np.float32)[:, None, None] * keep
    if correction.bad is not None:
        mask[correction.bad] |= np.uint8(Mask.BAD)
    signal = (total / weight).astype(np.float32)
    floor = floor + np.tensordot(correction.black.mean_variance(noise).astype(np.float32), share**2, axes=1)
    scale = np.float32(1) if flat is None else 1 / flat
    return MergedFrame(
        signal,
        mask,
        (noise.slope * shot * scale / weight**2).astype(np.float32),
        (floor * scale**2 / weight**2).astype(np.float32),
        None if correction.flat is None else correction.flat.relative_variance(noise)[0],
    )


def _signal(frame: NDArray[np.generic], black: Image, flat: Image | None, counts: CountsCorrection | None) -> Image:
    signal = frame.astype(np.float32) - black
    if flat is not None:
        signal /= flat
    if counts is not None:
        flattened = signal.reshape(1, 1, -1)
        counts.apply(flattened, *(at.reshape(-1) for at in places(*signal.shape)))
        signal = flattened.reshape(signal.shape)
    return signal
