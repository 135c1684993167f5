"""Light that changes or is uneven."""

from typing import Literal

import numpy as np
from pydantic import Field

from processing.arrays import Image
from simulators.bench.effects.base import BenchEffect, Shot


class DriftFault(BenchEffect):
    """The lamp's level changes by a fraction an hour."""

    kind: Literal["source_drift"] = "source_drift"
    fraction_per_hour: float = Field(default=0.0, description="relative change of the lamp's level in an hour")

    def source(self, level: float, shot: Shot) -> float:
        return level * (1 + self.fraction_per_hour * shot.time_s / 3600)


class FlickerFault(BenchEffect):
    """The lamp's level is random from exposure to exposure, relative standard deviation `sigma`."""

    kind: Literal["source_flicker"] = "source_flicker"
    sigma: float = Field(default=0.0, description="standard deviation, relative")

    def source(self, level: float, shot: Shot) -> float:
        return level * (1 + self.sigma * shot.random("flicker").standard_normal())


class SourceStep(BenchEffect):
    """The lamp jumps by a fraction at one exposure and stays there."""

    kind: Literal["source_step"] = "source_step"
    at_index: int = Field(default=0, description="number of the exposure, from 0, from which on it holds")
    fraction: float = Field(default=0.0, description="relative change of the lamp's level")

    def source(self, level: float, shot: Shot) -> float:
        return level * (1 + self.fraction) if shot.index >= self.at_index else level


class LevelFault(BenchEffect):
    """The source gives `factor` times its light: enough of it saturates the detector."""

    kind: Literal["source_level"] = "source_level"
    factor: float = Field(default=1.0, description="factor on the lamp's level")

    def source(self, level: float, shot: Shot) -> float:
        return level * self.factor


class UnevenLight(BenchEffect):
    """Uneven light on the field: it loses `corner_loss` towards the corners and grows by `gradient` over the rows."""

    kind: Literal["uneven_light"] = "uneven_light"
    corner_loss: float = Field(default=0.0, ge=0, lt=1, description="part of the light that is missing in the corners")
    gradient: float = Field(default=0.0, gt=-1, lt=1, description="relative change from the first row to the last")

    def optics(self, electrons: Image, shot: Shot) -> Image:
        y, x = (np.linspace(-1, 1, n, dtype=np.float32) for n in electrons.shape[-2:])
        loss = self.corner_loss * (x**2 + y[:, None] ** 2) / 2
        return np.asarray(electrons * (1 - loss + self.gradient * y[:, None] / 2), dtype=np.float32)
