"""Transmission that depends on how far an element has turned."""

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes
from processing.instrument.effects.base import OpticsEffect, turns
from processing.instrument.model import InstrumentModel


class Transmission(OpticsEffect):
    """Relative change of transmission, once and twice per turn of the element."""

    belongs_to = "dispersion"
    is_level = True
    fixed_parameters = tuple(Parameter(n, "1", -0.3, 0.3, 0.01) for n in ("cos_1", "sin_1", "cos_2", "sin_2"))

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        factor = 1 + sum(v * wave for v, wave in zip(values, turns(model, changes.conditions, place), strict=True))
        changes.gain = changes.gain * factor[:, None]
