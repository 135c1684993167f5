"""Base of the effects of one polarizer of one train."""

from collections.abc import Sequence
from typing import ClassVar, Literal

from processing.effect import Parameter
from processing.instrument.changes import Conditions
from processing.instrument.effects.base import NominalShift
from processing.instrument.model import InstrumentModel, Polarizer


class Extinction(NominalShift):
    """The extinction (T_min over T_max) of each polarizer of a train is larger than in the model."""

    train: ClassVar[Literal["generator", "analyzer"]]
    field = "extinction"
    # A little below zero is allowed, so that noise about a perfect polarizer is not pushed to one side.
    fixed_parameters = (Parameter("extinction", "1", -0.02, 0.5, 0.01),)

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return tuple(e.name for e in getattr(model, self.train) if isinstance(e, Polarizer))
