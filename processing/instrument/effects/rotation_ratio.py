"""An axis turns further, or less far, than its reading: a wrong scale, or the opposite sense.

Cause: counts per degree of another stage model, a gear or belt ratio typed wrongly, a mount seen from behind. A
published case: acquisition turned the analyzer by -4.91 times the generator's angle, reduction used +4.9.
Mend: turn ten turns and look at the mark; correct the counts per degree or the sign in the rig file.
"""

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes
from processing.instrument.effects.base import OfTurningAxis, turned_by
from processing.instrument.model import InstrumentModel


class RotationRatio(OfTurningAxis):
    """(true turn - turn read) / turn read; -2 is the opposite sense."""

    belongs_to = "mechanics"
    fixed_parameters = (Parameter("relative", "1", -2.1, 0.1, 0.001),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.turn_axis(place, values[0] * changes.conditions.angles_deg[place], turned_by(model, place))
