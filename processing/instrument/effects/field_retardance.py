"""A retarder's retardance varies smoothly over the image.

Cause: the field of view crosses the plate at an angle (retardance grows with the square of the tilt), a thickness
wedge, a temperature gradient, stress from the mount.
Mend: put the plate where the beam is collimated, use a true zero-order plate; or calibrate on air, pixel by pixel.
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import FIELD_TERMS, Changes, Conditions
from processing.instrument.effects.base import InstrumentEffect
from processing.instrument.model import InstrumentModel, Retarder


#: x and y run from -1 to 1 over the image, to the right and down.
class FieldRetardance(InstrumentEffect):
    """Coefficients in degrees of x, y, x^2 - 1/3, x y, y^2 - 1/3."""

    varies_over_image = True
    fixed_parameters = tuple(Parameter(n, "degree", -20, 20, 1.0) for n in FIELD_TERMS)

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return tuple(e.name for e in model.elements() if isinstance(e, Retarder))

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.field_retardance_rad[place] = changes.field_retardance_rad[place] + np.deg2rad(values)
