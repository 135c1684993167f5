"""From one state on, an axis is off by a fixed angle.

Cause: lost steps (stall, too much acceleration), a loose set screw, a person touched the mount.
Mend: lower speed and acceleration, tighten, home and repeat the capture from that state.
The diagnosis finds the state: its place is AXIS@STATE, the first state that is off (counted from 0).
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OfOneCapture, moving_axes, turned_by
from processing.instrument.model import InstrumentModel

#: Positions tried along a capture; with more states the nearest of these is named.
POSITIONS = 64


class RotationSlip(OfOneCapture):
    """Angle error in degrees from the state on."""

    fixed_parameters = (Parameter("slip", "degree", -45, 45, 1.0),)

    def slips(self, place: str) -> tuple[str, int]:
        axis, _, state = place.rpartition("@")
        return axis, int(state)

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        n = conditions.states
        # A slip at the first state is an azimuth error.
        tried = np.unique(np.round(np.linspace(1, n - 1, min(POSITIONS, max(n - 1, 0)))).astype(int))
        return tuple(f"{axis}@{k}" for axis in moving_axes(model, conditions) for k in tried)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        axis, first = self.slips(place)
        changes.turn_axis(axis, values[0] * (np.arange(changes.conditions.states) >= first), turned_by(model, axis))
