"""The angle of the source's arm differs from its reading.

Cause: the arm was homed against another stop, its zero was never checked at 180 degrees.
Mend: look straight through without sample and set the zero where the image of the source is centred.
"""

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.geometry.viewing import ViewingGeometry
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect


class ArmZero(ReflectanceEffect):
    """Degrees by which the source stands further round than the arm reads."""

    corrects = "geometry"
    fixed_parameters = (Parameter("arm", "degree", -10, 10, 0.5),)

    def bend(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        changes.arm_rad += float(np.deg2rad(values[0]))

    def corrected(self, view: ViewingGeometry, values: dict[str, float]) -> ViewingGeometry:
        return view.model_copy(update={"arm_zero_deg": view.arm_zero_deg + values["arm"]})
