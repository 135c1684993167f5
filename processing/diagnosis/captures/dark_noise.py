"""Noise of the dark frames, which all states of a pixel share."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.search.range_of import inside_and_outside
from processing.diagnosis.search.rules import LIMIT, LITTLE
from processing.instrument.model import InstrumentModel
from processing.reduction.black import Black
from processing.storage.captures.capture import Capture


def without_noise_of_darks(
    data: CaptureData,
    capture: Capture,
    model: InstrumentModel,
    *,
    states: NDArray[np.int64],
    black: Black,
    variance: Array,
) -> CaptureData:
    """The capture without the noise that its dark frames add to all states of a pixel.

    A mean of dark frames is wrong by the same counts in all states of an exposure. This error is estimated in each
    pixel, from what its states leave beside the model. Of the residual only so much is subtracted that the rest is
    white; of the light, the estimate. Errors that follow the light, or are alike in all pixels, are no such noise.

    Parameters
    ----------
    data : its `floor` is the noise of each state alone.
    model : of the capture, at its wavelength.
    states : (N,) numbers of the states of `data` in the capture.
    variance : (D,) of the means of the dark frames of each exposure, counts^2.
    """
    channels, counts = data.signal.shape[1], data.row_counts
    good = data.usable & ~data.clipped
    dark_sd = np.sqrt(variance) / data.conditions.full_scale / data.binned
    if not good.any() or not dark_sd.any():
        return data
    y = data.signal.reshape(-1, *data.usable.shape)
    light = np.maximum(y[:, good].mean(axis=1, dtype=float), 0)
    sd = np.sqrt(np.repeat(data.slope, channels) * light + np.repeat(data.floor, channels))[counts]
    # From here on in units of the noise of each state; along each of D dark errors in each channel, of unit variance.
    dark = (
        np.kron(black.weights(capture.column("exposure_s")[states]) * dark_sd, np.eye(channels))[counts] / sd[:, None]
    )
    rows = data.rows_of(model.model_copy(update={"effects": ()}))
    inside, outside = inside_and_outside(rows[counts] / sd[:, None])
    u, size, errors = np.linalg.svd(outside @ (outside.T @ dark), full_matrices=False)
    # Over all states of a pixel, in units of the noise of one.
    visible = size > LITTLE
    if not visible.any():
        return data
    u, size, in_light = u[:, visible], size[visible, None], inside @ (inside.T @ (dark @ errors[visible].T))
    spread = np.sqrt(1 + size**2)
    z = y[:, good][counts] / sd[:, None].astype(np.float32)
    residual, fit = u.astype(np.float32).T @ z / spread, inside.astype(np.float32).T @ z
    # Fit and residual share the dark error. Only a fit without it says what of the residual follows the light.
    centred = residual - residual.mean(axis=1, keepdims=True)
    light = fit - inside.T @ in_light @ (size / spread * centred)
    if data.place_px is not None and min(data.usable.shape) > 1:
        # Channels that look at places apart differ by the slopes of the light, in all states alike.
        images = np.tensordot((inside.T / sd).astype(np.float32), y[counts], 1)
        light = np.concatenate([light, *(slope[:, good] for slope in np.gradient(images, axis=(1, 2)))])
    # Without the mean over the pixels, and without the part that follows their light.
    basis = np.concatenate([np.ones_like(light[:1]), light])
    of_dark = np.asarray(residual - (residual @ np.linalg.pinv(basis)) @ basis, dtype=float)
    # A pixel with a hit, or a hot one, tells nothing of its dark frames.
    of_dark[np.abs(of_dark) > LIMIT] = 0.0
    subtracted = np.zeros((len(y), of_dark.shape[1]), dtype=np.float32)
    subtracted[counts] = sd[:, None] * (u @ ((spread - 1) * of_dark) + in_light @ (size / spread * of_dark))
    signal = data.signal.copy()
    signal.reshape(y.shape)[:, good] -= subtracted
    return replace(data, signal=signal)
