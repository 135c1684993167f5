"""Some of the light met two facets, or the object and its support, before it reached the camera.

Cause: rough or concave surfaces, a bright holder or table near the object.
Mend: black cloth around the object, a thin pin as support; leave concave parts out of the fit.
"""

from __future__ import annotations

from processing.changes import Conditions
from processing.effects._reflectance import ReflectanceEffect
from processing.effects.base import Array, Parameter
from processing.instrument import InstrumentModel
from processing.reflectance_changes import ReflectanceChanges


class This(ReflectanceEffect):
    """Weight of light that met two facets over that which met one."""

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return (Parameter("twice", "1", -0.05, 1.0, 0.05),)

    def bend(self, changes: ReflectanceChanges, values: Array) -> None:
        changes.twice += float(values[0])
