"""A retarder transmits its two axes unequally.

Cause: Fresnel losses of a tilted or uncoated plate, a dichroic polymer, dust along one axis.
Mend: tilt the plate back to normal incidence; measure both transmissions and put them into the model.
"""

from collections.abc import Sequence

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OpticsEffect
from processing.instrument.model import InstrumentModel, Retarder


class RetarderDiattenuation(OpticsEffect):
    """(T_fast - T_slow) / (T_fast + T_slow) of the retarder."""

    belongs_to = "dispersion"
    fixed_parameters = (Parameter("diattenuation", "1", -0.3, 0.3, 0.01),)

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return tuple(e.name for e in model.elements() if isinstance(e, Retarder))

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.diattenuation[place] = changes.diattenuation[place] + values[0]

    def shifts(self, model: InstrumentModel, place: str) -> tuple[str, ...]:
        return (f"{place}.diattenuation",)
