"""The object stands elsewhere in the image than the geometry says, so every normal is off.

Cause: sphere centre or mesh pose from another session, camera nudged, wrong pixel scale.
Mend: register again on the outline (`process geometry`), put the object back on its pin.
"""

from __future__ import annotations

import numpy as np

from processing.changes import Conditions
from processing.effects._reflectance import ReflectanceEffect
from processing.effects.base import Array, Parameter
from processing.instrument import InstrumentModel
from processing.reflectance_changes import ReflectanceChanges


class This(ReflectanceEffect):
    """Turn of all normals in degrees; on a sphere of radius R pixels one pixel is 57.3/R degrees at its centre."""

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return (Parameter("about_y", "degree", -10, 10, 0.5), Parameter("about_x", "degree", -10, 10, 0.5))

    def bend(self, changes: ReflectanceChanges, values: Array) -> None:
        y, x = np.deg2rad(values)
        changes.tilt_rad = (changes.tilt_rad[0] + float(y), changes.tilt_rad[1] + float(x))
