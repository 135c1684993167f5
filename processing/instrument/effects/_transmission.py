"""Transmission that depends on how far an element has turned."""

from collections.abc import Sequence
from typing import ClassVar

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OpticsEffect, moving_axes, turns
from processing.instrument.elements import Element
from processing.instrument.model import InstrumentModel


class Transmission(OpticsEffect):
    """Relative change of transmission, once and twice per turn of the element."""

    belongs_to = "dispersion"
    is_level = True
    element: ClassVar[type[Element]]
    fixed_parameters = tuple(Parameter(n, "1", -0.3, 0.3, 0.01) for n in ("cos_1", "sin_1", "cos_2", "sin_2"))

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        axes = moving_axes(model, conditions)
        return tuple(e.name for e in model.elements() if isinstance(e, self.element) and e.axis in axes)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        factor = 1 + sum(v * wave for v, wave in zip(values, turns(model, changes.conditions, place), strict=True))
        changes.gain = changes.gain * factor[:, None]
