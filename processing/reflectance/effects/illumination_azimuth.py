"""The polarization of the illumination is turned against the axes that the model takes.

Cause: polarizer of the source not horizontal, arm or source rolled about the beam.
Mend: level the source's polarizer against the camera's with the arm at 180 degrees.
"""

from __future__ import annotations

import numpy as np

from processing.arrays import Array
from processing.instrument.changes import Conditions
from processing.instrument.effects.base import Parameter
from processing.instrument.model import InstrumentModel
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect


class This(ReflectanceEffect):
    """Degrees by which the generator azimuth is off."""

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return (Parameter("azimuth", "degree", -20, 20, 1.0),)

    def bend(self, changes: ReflectanceChanges, values: Array) -> None:
        changes.generator_rad += float(np.deg2rad(values[0]))
