"""The axis lags behind its reading by a fixed angle whose sign follows the last direction of turning.

Cause: play in worm, gear or belt. It needs states that are reached from both sides; otherwise it is an azimuth error.
Mend: approach every position from the same side (most controllers have a setting), or take the encoder on the shaft.
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import InstrumentEffect, moving_axes, turned_by
from processing.instrument.model import InstrumentModel


def direction(angle_deg: Array) -> Array:
    """+1 or -1 (N,): the side to which the axis moved last; the first state counts as a move upwards."""
    step = np.sign(np.diff(angle_deg, prepend=angle_deg[0] - 1.0))
    for n in np.flatnonzero(step == 0):
        step[n] = step[n - 1]
    return np.asarray(step, dtype=float)


class RotationBacklash(InstrumentEffect):
    """Half of the play in degrees: angle = reading - backlash * direction."""

    belongs_to = "mechanics"
    fixed_parameters = (Parameter("backlash", "degree", -5, 5, 0.2),)

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        axes = moving_axes(model, conditions)
        return tuple(a for a in axes if np.ptp(direction(conditions.angles_deg[a])) > 0)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        side = direction(changes.conditions.angles_deg[place])
        changes.turn_axis(place, -values[0] * side, turned_by(model, place))
