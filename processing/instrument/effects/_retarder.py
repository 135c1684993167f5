"""Base of the effects of one retarder of one train."""

from collections.abc import Sequence
from typing import ClassVar, Literal

from processing.effect import Parameter
from processing.instrument.changes import Conditions
from processing.instrument.effects.base import NominalShift, retarders
from processing.instrument.model import InstrumentModel


class RetarderEffect(NominalShift):
    """One number of each retarder of a train."""

    train: ClassVar[Literal["generator", "analyzer"]]

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return retarders(model, self.train)


class Retardance(RetarderEffect):
    """The retardance differs from the model's."""

    belongs_to = "dispersion"
    field = "retardance_deg"
    fixed_parameters = (Parameter("retardance", "degree", -90, 90, 1.0),)


class Azimuth(RetarderEffect):
    """The fast axis differs from the model."""

    belongs_to = "mechanics"
    field = "azimuth_deg"
    fixed_parameters = (Parameter("azimuth", "degree", -90, 90, 1.0),)
