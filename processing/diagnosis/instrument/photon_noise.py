"""Counts with a correction undone exactly, and the noise of the light that the corrected counts show.

Photon noise follows the light, not the counts: behind a bent response the two differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captures.capture_data import CaptureData, Correct
from processing.diagnosis.captures.noise import DetectorNoise, detector_noise, noise_factors
from processing.diagnosis.instrument.features import MARGIN
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.rules import DARK_NOISE_OFF, LITTLE, NOISE_OFF, SHOWN
from processing.diagnosis.search.space import Space


def movable(shift_px: Array) -> bool:
    """Whether frames can be moved back by (N, 2) pixels and no used pixel needs what lies beyond the edge."""
    return bool(np.abs(shift_px).max() <= MARGIN)


def about_mean(shift_px: Array) -> Array:
    """Shifts (N, 2), pixels, from their mean. The fitted image has moved by the mean, so frames are moved the least."""
    return np.asarray(shift_px - shift_px.mean(axis=0))


def distance(undone: Mapping[Candidate, Array], space: Space, values: Array, *, pointwise: bool = False) -> float:
    """Largest distance of a correction from where it was undone, in typical sizes; of the `pointwise` ones alone."""
    away = [0.0]
    for candidate, part in space.pairs:
        if _exactly_undone(candidate, pointwise):
            away.append(float(np.max(np.abs(values[part] - undone.get(candidate, 0.0)) / candidate.typical)))
    return max(away)


def _exactly_undone(candidate: Candidate, pointwise: bool) -> bool:
    """Whether a correction has to be undone exactly, as far off a line; with `pointwise`, to know the light."""
    return candidate.is_pointwise or (candidate.moves_image and not pointwise)


def exactly_undone(space: Space, values: Array, *, pointwise: bool = False) -> dict[Candidate, Array]:
    """Values of what can be undone exactly; of the `pointwise` corrections alone."""
    active = space.pairs
    return {c: values[p] for c, p in active if _exactly_undone(c, pointwise) and values[p].any()}


def undoing(data: CaptureData, undone: Mapping[Candidate, Array]) -> Correct:
    """Function that undoes the effects exactly in signals of a capture, and returns the slope by the old signals."""

    def correct(signal: Array) -> tuple[Array, Array]:
        slope = np.ones(())
        for candidate, values in undone.items():
            if candidate.of_instrument and candidate.is_pointwise:
                signal, step = candidate.of_instrument.undo(signal, data.conditions, candidate.place, values)
                slope = slope * step
        return signal, slope

    return correct


def with_noise_of_light(data: CaptureData, a: Array, bends: Mapping[Candidate, Array]) -> CaptureData | None:
    """The same counts with the noise of the light that they tell, as large as differences of pixels show it.

    Whether it is what is stated is asked anew behind these `bends`. Then both of its parts are scaled, by no more than
    labs mistake. None where no such gain goes with these bends: counts do not scatter as the light would.

    Parameters
    ----------
    data : not moved; a (L, K) : rows of its model, not weighted.
    """
    shared = data.shared.shown < 1 or data.shared.rows > 0 or data.shared.columns > 0
    if not data.noise_known or data.noise_estimated or shared:
        return _use_light_noise(data, bends)
    least, usual = max(abs(data.noise_level[0] - 1), NOISE_OFF / 2), (1.0, 1.0)
    # An offset looks like another read-out noise, and the reverse.
    data = _scale_noise(data, usual if bends else data.noise_factors, usual)
    noise = _detector_noise(data, a, bends)
    if noise is None:
        return _use_light_noise(data, bends)
    factors = noise_factors(noise, 1.0, estimated=False) if bends else data.noise_factors
    if bends and factors == usual and abs(noise.white - 1) > least + SHOWN * noise.white_error:
        return None
    if factors != data.noise_factors:
        data = _scale_noise(data, factors, usual)
        noise = _detector_noise(data, a, bends) or noise
    return _use_light_noise(_scale_noise(data, factors, _level(noise)), bends)


def _level(noise: DetectorNoise) -> tuple[float, float]:
    """How much larger the noise with and without light is than is stated: the mean under what labs know of both.

    A constant offset that nothing else shows changes the noise without light alone.
    """
    common, dark = (NOISE_OFF / 4) ** 2, np.diag([0.0, DARK_NOISE_OFF**2])
    prior = common + dark
    deviation = prior @ np.linalg.solve(prior + noise.covariance, np.array([noise.shot, noise.dark]) - 1)
    return float(np.clip(1 + deviation[0], 1 - NOISE_OFF, 1 + NOISE_OFF)), float(max(1 + deviation[1], LITTLE))


def _scale_noise(data: CaptureData, factors: tuple[float, float], level: tuple[float, float]) -> CaptureData:
    """The capture with another noise than is stated, by factors on its parts with and without light."""
    old = np.multiply(data.noise_factors, data.noise_level)
    slope, floor = np.multiply(factors, level) / old
    return replace(data, slope=data.slope * slope, floor=data.floor * floor, noise_factors=factors, noise_level=level)


def _use_light_noise(data: CaptureData, bends: Mapping[Candidate, Array]) -> CaptureData:
    return data.with_noise_of(undoing(data, bends)) if bends else replace(data, true_variance=None)


def _detector_noise(data: CaptureData, a: Array, bends: Mapping[Candidate, Array]) -> DetectorNoise | None:
    if data.wide is not None:
        # Differences of pixels show nothing of what is common to all of them.
        data = replace(data, slope=data.slope / data.wide, floor=data.floor / data.wide)
    corrected = _use_light_noise(data, bends)
    return detector_noise(corrected.undone(undoing(data, bends)) if bends else corrected, a)
