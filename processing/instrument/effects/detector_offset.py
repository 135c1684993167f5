"""The counts contain a constant after the dark is subtracted, or too much is subtracted.

Cause: no dark frames, dark frames at another exposure, gain or temperature, a black level that moved.
Under an unknown sample it looks like depolarization, and like stray light of a uniform image.
Mend: take dark states with the same exposure before and after; fix the black level in the camera.
"""

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import PointwiseEffect
from processing.instrument.model import InstrumentModel


class DetectorOffset(PointwiseEffect):
    """Counts that are left over in every pixel and state."""

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        top = conditions.full_scale
        # Four counts of twelve bits: a black level is read off dark frames, or off the sheet of the camera.
        return (Parameter("offset", "count", -0.1 * top, 0.1 * top, 0.001 * top),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        full_scale = changes.conditions.full_scale
        changes.response["one"] = changes.response["one"] - values[0] / full_scale

    def undo(self, signal: Array, conditions: Conditions, place: str, values: Array) -> tuple[Array, Array]:
        return signal - values[0] / conditions.full_scale, np.ones_like(signal)
