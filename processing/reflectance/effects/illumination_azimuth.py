"""The polarization of the illumination is turned against the axes of the model.

Cause: polarizer of the source not horizontal, arm or source rolled about the beam.
Mend: level the source's polarizer against the camera's with the arm at 180 degrees.
"""

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect


class SurfaceIlluminationAzimuth(ReflectanceEffect):
    """Degrees by which the generator azimuth is off."""

    fixed_parameters = (Parameter("azimuth", "degree", -20, 20, 1.0),)

    def bend(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        changes.generator_rad += float(np.deg2rad(values[0]))
