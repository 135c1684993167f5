"""Light reaches the detector without passing the polarization optics, the same in every state.

Cause: a reflection past the analyzer, room light, a leaking housing, veiling glare of the lens.
A constant is within the column space of W: an unknown sample absorbs it.
Mend: baffle; measure with the beam blocked before the generator and subtract that as dark.
"""

from collections.abc import Sequence

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OpticsEffect
from processing.instrument.model import InstrumentModel


class StrayLight(OpticsEffect):
    """Stray light over the mean signal that the same throughput gives without polarization."""

    fixed_parameters = (Parameter("fraction", "1", -0.05, 1.0, 0.01),)

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if model.axes else ()

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.stray += float(values[0])
