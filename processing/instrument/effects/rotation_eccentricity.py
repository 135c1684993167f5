"""An axis differs from its reading by an error that repeats once and twice per turn.

Cause: the encoder's scale or the worm wheel sits eccentric on the shaft (once), is oval or tilted (twice).
Mend: map the error with a second encoder or on air, and write the correction into the controller or the model.
"""

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes
from processing.instrument.effects.base import OfTurningAxis, turned_by
from processing.instrument.model import InstrumentModel


class RotationEccentricity(OfTurningAxis):
    """Angle error in degrees: cos and sin of the axis angle, then of twice the angle."""

    belongs_to = "mechanics"
    fixed_parameters = tuple(Parameter(n, "degree", -5, 5, 0.3) for n in ("cos_1", "sin_1", "cos_2", "sin_2"))

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        t = np.deg2rad(changes.conditions.angles_deg[place])
        error = values[0] * np.cos(t) + values[1] * np.sin(t) + values[2] * np.cos(2 * t) + values[3] * np.sin(2 * t)
        changes.turn_axis(place, error, turned_by(model, place))
