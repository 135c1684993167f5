"""Each state's angle of one axis is off by its own amount.

Cause: poor repeatability, read-back taken while still moving, missed settling.
Mend: read the position after the stage is idle, allow it to settle, calibrate with an encoder on the shaft.
With one known sample, one channel and one throughput it can explain any residual, so it has no name there.
"""

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OfTurningAxis, ValuePerState, turned_by
from processing.instrument.model import InstrumentModel


class AnglePerState(OfTurningAxis, ValuePerState):
    """Angle error of each state in degrees."""

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"state_{k}", "degree", -10, 10, 0.3) for k in range(conditions.states))

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.turn_axis(place, values, turned_by(model, place))
