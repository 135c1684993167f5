"""Corrections of the counts that are undone exactly at a point of expansion: how far it is, and the signal there."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData, Correct
from processing.diagnosis.instrument.features import MARGIN
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.space import Space
from processing.instrument.effects.base import PointwiseEffect


def movable(shift_px: Array) -> bool:
    """Whether frames can be moved back by (N, 2) pixels and no used pixel needs what lies beyond the edge."""
    return bool(np.abs(shift_px).max() <= MARGIN)


def distance(undone: Mapping[Candidate, Array], space: Space, values: Array, *, pointwise: bool = False) -> float:
    """Largest distance of a correction from where it was undone, in typical sizes; of the `pointwise` ones alone."""
    away = [0.0]
    for candidate, part in zip(space.candidates, space.slices, strict=True):
        if _exactly_undone(candidate, pointwise):
            away.append(float(np.max(np.abs(values[part] - undone.get(candidate, 0.0)) / candidate.typical)))
    return max(away)


def _exactly_undone(candidate: Candidate, pointwise: bool) -> bool:
    """Whether a correction can be undone exactly; with `pointwise`, in each pixel by itself."""
    return isinstance(candidate.effect, PointwiseEffect) or (candidate.moves_image and not pointwise)


def exactly_undone(space: Space, values: Array, *, pointwise: bool = False) -> dict[Candidate, Array]:
    """Values of what can be undone exactly; of the `pointwise` corrections alone."""
    active = zip(space.candidates, space.slices, strict=True)
    return {c: values[p] for c, p in active if _exactly_undone(c, pointwise) and values[p].any()}


def undoing(data: CaptureData, undone: Mapping[Candidate, Array]) -> Correct:
    """What undoes the effects exactly in signals of a capture, and gives the slope over the old ones."""

    def correct(signal: Array) -> tuple[Array, Array]:
        slope = np.ones(())
        for candidate, values in undone.items():
            if isinstance(candidate.effect, PointwiseEffect):
                signal, step = candidate.effect.undo(signal, data.conditions, values)
                slope = slope * step
        return signal, slope

    return correct
