"""Base of the effects of one retarder of one train."""

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OpticsEffect, retarders
from processing.instrument.model import InstrumentModel


class RetarderEffect(OpticsEffect):
    """One number of each retarder of a train."""

    train: ClassVar[Literal["generator", "analyzer"]]

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return retarders(model, self.train)


class Retardance(RetarderEffect):
    """The retardance differs from the model's."""

    belongs_to = "dispersion"
    fixed_parameters = (Parameter("retardance", "degree", -40, 40, 1.0),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.retardance_rad[place] = changes.retardance_rad[place] + np.deg2rad(values[0])

    def shifts(self, model: InstrumentModel, place: str) -> tuple[str, ...]:
        return (f"{place}.retardance_deg",)


class Azimuth(RetarderEffect):
    """The fast axis differs from the model."""

    belongs_to = "mechanics"
    fixed_parameters = (Parameter("azimuth", "degree", -45, 45, 1.0),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.azimuth_rad[place] = changes.azimuth_rad[place] + np.deg2rad(values[0])

    def shifts(self, model: InstrumentModel, place: str) -> tuple[str, ...]:
        return (f"{place}.azimuth_deg",)
