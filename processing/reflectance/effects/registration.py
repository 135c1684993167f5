"""The object stands elsewhere in the image than the geometry says, so every normal is off.

Cause: sphere centre or mesh pose from another session, camera nudged, wrong pixel scale.
Mend: register again on the outline (`process geometry`), put the object back on its pin.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.instrument.changes import Conditions
from processing.instrument.effects.base import Parameter
from processing.instrument.model import InstrumentModel
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect


class This(ReflectanceEffect):
    """Offset in mm (x to the right, y up) and relative size of a sphere; of bare points, turn of all normals (degrees).

    Size stands for the camera's scale as well: one image cannot tell the two apart.
    """

    def places_on(self, shape: str) -> Sequence[str]:
        return ("sphere",) if shape == "sphere" else ("",)

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        if place == "sphere":
            offsets = (Parameter(n, "mm", -2.0, 2.0, 0.2) for n in ("x", "y"))
            return (*offsets, Parameter("scale", "1", -0.1, 0.1, 0.01))
        return (Parameter("about_y", "degree", -10, 10, 0.5), Parameter("about_x", "degree", -10, 10, 0.5))

    def bend(self, changes: ReflectanceChanges, values: Array) -> None:
        y, x = np.deg2rad(values)
        changes.tilt_rad = (changes.tilt_rad[0] + float(y), changes.tilt_rad[1] + float(x))

    def bend_at(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        if place != "sphere":
            self.bend(changes, values)
            return
        x, y, scale = (float(v) for v in values)
        changes.centre_mm = (changes.centre_mm[0] + x, changes.centre_mm[1] + y)
        changes.scale += scale
