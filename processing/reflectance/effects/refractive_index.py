"""The surface's refractive index is not the one of the material file.

Cause: an index from a table for another batch, wavelength, paint or finish; an oxide or an oil film.
Mend: fit it (`process fit-material`), or measure it on a polished piece with an ellipsometer.
"""

from __future__ import annotations

from processing.arrays import Array
from processing.instrument.changes import Conditions
from processing.instrument.effects.base import Parameter
from processing.instrument.model import InstrumentModel
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect


class This(ReflectanceEffect):
    """What has to be added to n and k; more than these bounds is another material, or no first surface at all."""

    bent = True

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return (Parameter("n", "1", -0.3, 0.3, 0.05), Parameter("k", "1", -0.3, 0.3, 0.05))

    def bend(self, changes: ReflectanceChanges, values: Array) -> None:
        changes.index += complex(*values)
