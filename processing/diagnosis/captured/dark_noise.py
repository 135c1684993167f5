"""Noise of the dark frames, which all states of a pixel share: a capture without it has independent noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.calibration.known_sample import known_mueller
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.search.range_of import inside_and_outside
from processing.diagnosis.search.rules import OUTSTANDING
from processing.instrument.model import InstrumentModel
from processing.reduction.black import Black
from processing.reduction.measurement_matrix import measurement_matrix
from processing.reduction.noise import NoiseModel
from processing.storage.captures.capture import Capture

#: [of the noise of one state] Noise of the dark frames in all states together that changes nothing.
UNSEEN = 1e-3


def without_noise_of_darks(
    data: CaptureData,
    capture: Capture,
    model: InstrumentModel,
    *,
    states: NDArray[np.int64],
    black: Black,
    noise: NoiseModel,
) -> CaptureData:
    """The capture with the noise made independent that its dark frames add to all states of a pixel.

    A mean of dark frames is wrong by the same counts in all states of an exposure. Where its error stands out of the
    noise of a state, it is estimated from what the states of a pixel leave beside the model, and that part is
    subtracted which makes the rest white. What goes with the light, or is alike in all pixels, is no such noise.
    """
    counts, sd = data.row_counts, np.sqrt(black.mean_variance(noise)) / data.conditions.full_scale / data.binned
    good = data.usable & ~data.clipped
    if not good.any() or not sd.any():
        return data
    channels = data.signal.shape[1]
    shared = np.kron(black.weights(capture.column("exposure_s")[states]) * sd, np.eye(channels))[counts]
    a = measurement_matrix(capture, model.model_copy(update={"effects": ()}), states)
    a = a @ known_mueller(capture.header.sample).reshape(16, 1) if capture.header.sample.kind != "unknown" else a
    y = data.signal.reshape(-1, *data.usable.shape)
    mean = y[:, good].mean(axis=1, dtype=float)
    level = np.sqrt(np.repeat(data.slope, channels) * np.maximum(mean, 0) + np.repeat(data.floor, channels))[counts]
    inside, outside = inside_and_outside(a.reshape(len(y), -1)[counts] / level[:, None])
    shared /= level[:, None]
    u, size, of_error = np.linalg.svd(outside @ (outside.T @ shared), full_matrices=False)
    seen = size > UNSEEN
    if not seen.any():
        return data
    u, size, reached = u[:, seen], size[seen, None], inside @ (inside.T @ (shared @ of_error[seen].T))
    noise_along = np.sqrt(1 + size**2)
    z = y[:, good][counts] / level[:, None].astype(np.float32)
    told, light = u.astype(np.float32).T @ z / noise_along, inside.astype(np.float32).T @ z
    # Light and residual share the noise of the darks: what is left of the light tells nothing of them.
    own = light - inside.T @ reached @ (size / noise_along * (told - told.mean(axis=1, keepdims=True)))
    told = _beside(told, own)
    # A pixel with a hit, or a hot one, tells nothing of its dark frames.
    told[np.abs(told) > OUTSTANDING] = 0.0
    signal = data.signal.copy()
    taken = np.zeros((len(y), told.shape[1]), dtype=np.float32)
    # Along u as much is left as a state has of noise; of what the light takes up, the likeliest is subtracted.
    taken[counts] = level[:, None] * (u @ (told * (noise_along - 1)) + reached @ (told * size / noise_along))
    signal.reshape(y.shape)[:, good] -= taken
    return replace(data, signal=signal)


def _beside(told: Array, light: Array) -> Array:
    """What of numbers (B, P) is neither alike in all pixels nor goes with the light (K, P)."""
    known = np.concatenate([np.ones_like(light[:1]), light])
    return np.asarray(told - (told @ np.linalg.pinv(known)) @ known, dtype=float)
