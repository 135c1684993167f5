"""The detector's response is not proportional to the light: it bends towards the top of its range.

Cause: the well capacitance changes with charge, the amplifier saturates softly, a camera's "gamma" is on.
Mend: measure signal against exposure time at constant light, stay below about 70 % of full well, correct the counts.
counts = light (1 - c light / full scale), which is inverted exactly.
"""

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import PointwiseEffect
from processing.instrument.model import InstrumentModel


class DetectorNonlinearity(PointwiseEffect):
    """Fraction c of the signal that is lost at full scale."""

    is_response = True
    fixed_parameters = (Parameter("lost_at_full_scale", "1", -0.2, 0.2, 0.01),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        c = values[0]
        # Series of the exact inverse (1 - sqrt(1 - 4 c y)) / (2 c) = y + c y^2 + 2 c^2 y^3 + 5 c^3 y^4 + ...
        for name, factor in (("square", c), ("cube", 2 * c**2), ("fourth", 5 * c**3)):
            changes.response[name] = changes.response[name] + factor

    def undo(self, signal: Array, conditions: Conditions, place: str, values: Array) -> tuple[Array, Array]:
        # y = x - c x^2 has its top at y = 1 / (4 c), beyond the range for the bounds of c.
        root = np.sqrt(np.maximum(1 - 4 * values[0] * signal, 0.01))
        return 2 * signal / (1 + root), 1 / root
