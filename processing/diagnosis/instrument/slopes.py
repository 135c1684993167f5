"""Derivatives by the values of the candidates: of the rows of a capture, and of the coefficients of its counts."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.rules import STEP
from processing.diagnosis.search.space import Space
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import turned_by
from processing.instrument.model import InstrumentModel

#: Makes A (..., L, K) of the changes of a capture.
Columns = Callable[[Changes], Array]
#: Makes the changes of a capture of the values (K,) of a space.
ChangesOf = Callable[[Array], Changes]


def slopes_of_rows(
    changes_of: ChangesOf,
    model: InstrumentModel,
    conditions: Conditions,
    space: Space,
    *,
    values: Array,
    a: Array,
    columns: Columns,
    varying: bool = True,
) -> Array:
    """Derivatives (values, ..., L, K) of a (..., L, K), which `columns` makes of the changes.

    Zero by the values of effects that act on counts alone; also of those that vary over the image, if not `varying`.
    """
    da = np.zeros((space.size, *a.shape))
    channels = len(conditions.channels)
    by_axis: dict[str, Array] = {}
    for candidate, part in fitted(space):
        if candidate.acts_on_counts or (candidate.effect.varies_over_image and not varying):
            continue
        if candidate.effect.per_state:
            # Parameter n acts on state n alone: one step of all of them together gives every derivative.
            moved = values.copy()
            step = STEP * candidate.typical
            moved[part] += step
            slope = (columns(changes_of(moved)) - a) / step.repeat(channels)[:, None]
            for n in range(candidate.size):
                rows = slice(n * channels, (n + 1) * channels)
                da[part.start + n, ..., rows, :] = slope[..., rows, :]
            continue
        slips = candidate.effect.slips(candidate.place)
        if slips is not None and not values[part].any():
            # The same step of the same axis from another state on: one evaluation serves all of them.
            axis, first = slips
            if axis not in by_axis:
                turned = changes_of(values)
                turned.turn_axis(axis, np.full(conditions.states, STEP), turned_by(model, axis))
                by_axis[axis] = (columns(turned) - a) / STEP
            da[part.start, ..., first * channels :, :] = by_axis[axis][..., first * channels :, :]
            continue
        for j, (moved, step_j) in enumerate(step_values(candidate, part, values)):
            da[part.start + j] = (columns(changes_of(moved)) - a) / step_j
    return da


def slopes_of_counts(
    changes_of: ChangesOf, coefficients: Callable[[Changes], Array], space: Space, values: Array, *, c: Array
) -> Array:
    """Derivatives (values, F, L) of the coefficients c (F, L) of the corrected counts."""
    dc = np.zeros((space.size, *c.shape))
    for candidate, part in fitted(space):
        if candidate.acts_on_counts:
            for j, (moved, step) in enumerate(step_values(candidate, part, values)):
                dc[part.start + j] = (coefficients(changes_of(moved)) - c) / step
    return dc


def fitted(space: Space) -> list[tuple[Candidate, slice]]:
    """Candidates that have values to fit."""
    pairs = space.pairs
    return [(c, part) for c, part in pairs if not c.effect.is_switch]


def step_values(candidate: Candidate, part: slice, values: Array) -> Iterator[tuple[Array, float]]:
    """All values with one of a candidate's after the other moved by a small step, and the step."""
    for j, step in enumerate(STEP * candidate.typical):
        moved = values.copy()
        moved[part.start + j] += step
        yield moved, step
