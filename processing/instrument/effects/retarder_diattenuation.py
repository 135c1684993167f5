"""A retarder transmits its two axes unequally.

Cause: Fresnel losses of a tilted or uncoated plate, a dichroic polymer, dust along one axis.
Mend: tilt the plate back to normal incidence; measure both transmissions and put them into the model.
"""

from collections.abc import Sequence

from processing.effect import Parameter
from processing.instrument.changes import Conditions
from processing.instrument.effects.base import NominalShift
from processing.instrument.model import InstrumentModel, Retarder


class RetarderDiattenuation(NominalShift):
    """(T_fast - T_slow) / (T_fast + T_slow) of the retarder."""

    belongs_to = "dispersion"
    field = "diattenuation"
    fixed_parameters = (Parameter("diattenuation", "1", -0.3, 0.3, 0.01),)

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return tuple(e.name for e in model.elements() if isinstance(e, Retarder))
