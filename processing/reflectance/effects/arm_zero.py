"""The source's arm stands beside its reading.

Cause: the arm was homed against another stop, its zero was never checked at 180 degrees.
Mend: look straight through without sample and set the zero where the image of the source is centred.
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
    """Degrees by which the source stands further round than the arm reads."""

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return (Parameter("arm", "degree", -10, 10, 0.5),)

    def bend(self, changes: ReflectanceChanges, values: Array) -> None:
        changes.arm_rad += float(np.deg2rad(values[0]))
