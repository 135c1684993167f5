"""Some of the light met two facets, or the object and its support, before it reached the camera.

Cause: rough or concave surfaces, a bright holder or table near the object.
Mend: black cloth around the object, a thin pin as support; leave concave parts out of the fit.
"""

from __future__ import annotations

from collections.abc import Sequence

from processing.changes import Conditions
from processing.effects._reflectance import ReflectanceEffect
from processing.effects.base import Array, Parameter
from processing.instrument import InstrumentModel
from processing.reflectance_changes import ReflectanceChanges


class This(ReflectanceEffect):
    """Weight of light that met two facets over that which met one; place "support": light from below.

    The support's light arrives depolarized and the surface polarizes it as it does the source's; the parameter is its
    irradiance over the source's where both fall straight on the surface.
    """

    # Where the support stands and how far it reaches is not known.
    rough = 0.2

    def places_on(self, shape: str) -> Sequence[str]:
        return ("", "support")

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        if place == "support":
            return (Parameter("support", "1", -0.05, 2.0, 0.02),)
        return (Parameter("twice", "1", -0.05, 1.0, 0.05),)

    def bend(self, changes: ReflectanceChanges, values: Array) -> None:
        changes.twice += float(values[0])

    def bend_at(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        if place == "support":
            changes.support += float(values[0])
        else:
            self.bend(changes, values)
