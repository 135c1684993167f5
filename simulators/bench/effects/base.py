"""Effects of a real bench that its declared model lacks: small objects, each acting at one stage of an exposure.

A stage sees what light sees there: `train` the axes and the optics, `source` the light level, `optics` the image in
electrons before the detector collects it, `detector` the electrons collected. Each effect is one physical cause with
its size in physical units, and does nothing at size zero.
"""

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from processing.arrays import Image
from processing.instrument.model import InstrumentModel
from processing.section import Section


@dataclass(frozen=True)
class Shot:
    """One exposure, as the effects see it.

    `time_s` is when it is, by the clock that stamps the frames; `light` is what the source gives of its nominal light.
    """

    index: int
    exposure_s: float
    time_s: float
    seed: int
    angles_deg: Mapping[str, float] = field(default_factory=dict)
    light: float = 1.0

    def random(self, name: str) -> np.random.Generator:
        """Random numbers of one cause in this exposure: same seed and index, same numbers."""
        return np.random.default_rng([self.seed, self.index + (1 << 31), zlib.crc32(name.encode())])


class BenchEffect(Section):
    """Does nothing at any stage; an effect overrides the one it acts on."""

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        """Stage `train`: true angles of the optics in degrees."""
        return angles_deg

    def train(self, model: InstrumentModel, shot: Shot) -> InstrumentModel:
        """Stage `train`: the optics as they are in this exposure."""
        return model

    def field(self, image: Image, model: InstrumentModel, seen: Callable[[InstrumentModel], Image]) -> Image:
        """Stage `train`, for optics that differ over the image: `seen` gives the image through other optics."""
        return image

    def source(self, level: float, shot: Shot) -> float:
        """Stage `source`: light level, 1 = nominal."""
        return level

    def optics(self, electrons: Image, shot: Shot) -> Image:
        """Stage `optics`: expected electrons (rows, columns) before shot noise."""
        return electrons

    def detector(self, electrons: Image, shot: Shot) -> Image:
        """Stage `detector`: collected electrons (rows, columns), before full well, read noise and digitizing."""
        return electrons


def with_element(model: InstrumentModel, name: str, **values: Any) -> InstrumentModel:
    """A copy of the model with other values in the element of that name; KeyError if there is none."""
    if name not in {e.name for e in model.elements()}:
        raise KeyError(f"instrument {model.name!r} has no element {name!r}")

    def change(elements: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(e.model_copy(update=values) if e.name == name else e for e in elements)

    channels = tuple(c.model_copy(update={"elements": change(c.elements)}) for c in model.channels)
    trains = {"generator": change(model.generator), "analyzer": change(model.analyzer), "channels": channels}
    return model.model_copy(update=trains)
