"""Changes of one capture by effects: each effect is asked once for the same values, and what it says is kept."""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.rules import KEPT
from processing.diagnosis.search.space import Space
from processing.instrument.applied_effects import changes_of
from processing.instrument.changes import Built, Changes
from processing.instrument.model import InstrumentModel


class CaptureChanges:
    """Changes of one capture, by the effects of its model and by candidates.

    Parameters
    ----------
    capture : its number among all; model : resolved at its wavelength.
    moved_back_px : (N, 2) pixels of the sensor by which its frames were moved back, as the model says.
    """

    def __init__(self, capture: int, model: InstrumentModel, data: CaptureData, moved_back_px: Array) -> None:
        self._capture, self._model, self._moved_back_px = capture, model, moved_back_px
        self._conditions, self._name, self._nm = data.conditions, data.name, data.wavelength_nm
        self._built: Built = {}
        self._by_values: dict[tuple[str, str, bytes], Changes] = {}

    def of(self, space: Space, values: Array) -> Changes:
        """Changes with the instrument's own effects and the candidates of a space, whose values are (K,)."""
        if len(self._built) > KEPT:
            self._built.clear()
        changes = self._by(None, np.zeros(0)).copied(self._built)
        # At zero an effect does nothing: there is no need to ask it.
        for candidate, part in space.other_than_zero(values):
            if candidate.acts(self._capture, self._nm):
                changes.add(self._by(candidate, part))
        return changes

    def about(self, space: Space, values: Array) -> Callable[[Array], Changes]:
        """Changes of values of which those of one candidate differ: all before it and behind it are joined once."""
        none = Changes(self._conditions)

        def joined(*parts: Changes) -> Changes:
            first, *others = [part for part in parts if part is not none] or [none]
            if not others:
                return first
            total = first.copied(self._built)
            for part in others:
                total.add(part)
            return total

        pairs = space.pairs
        each = [self._by(c, values[p]) if values[p].any() else none for c, p in pairs]
        before = list(accumulate([self._by(None, np.zeros(0)), *each], joined))
        behind = list(accumulate([none, *reversed(each)], lambda later, part: joined(part, later)))[::-1]

        def changes(moved: Array) -> Changes:
            differ = np.flatnonzero(moved != values)
            if not differ.size:
                return before[-1].copied(self._built)
            i = space.owner(int(differ[0]))
            return joined(before[i], self._by(pairs[i][0], moved[pairs[i][1]]), behind[i + 1])

        return changes

    def _by(self, candidate: Candidate | None, values: Array) -> Changes:
        """Changes by one candidate alone, not to be altered; None: by the instrument's own effects."""
        key = (candidate.kind if candidate else "", candidate.place if candidate else "", values.tobytes())
        if key not in self._by_values:
            if len(self._by_values) > KEPT:
                self._by_values.clear()
            if candidate:
                changes = Changes(self._conditions)
                candidate.apply(changes, self._model, values)
            else:
                changes = changes_of(self._model, self._conditions, self._name)
                if self._moved_back_px.any():
                    changes.shift_px = changes.shift_px - self._moved_back_px
            self._by_values[key] = changes
        return self._by_values[key]
