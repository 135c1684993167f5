"""What a real bench does that its declared model does not: small objects, each acting at one stage of an exposure.

A stage sees what light sees there: `train` the axes and the optics, `source` the light level, `optics` the image in
electrons before the detector collects it, `detector` the electrons collected. Each effect is one physical cause with
its size in physical units, and does nothing at size zero.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from processing.instrument.model import InstrumentModel

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Shot:
    """One exposure, as the effects see it. `time_s` is scheduled time, not wall time, so that runs repeat.

    `light` is what the source gives of its nominal light.
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


class BenchEffect(BaseModel):
    """Does nothing at any stage; an effect overrides the one it acts on."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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


def _value(model: InstrumentModel, element: str, name: str) -> float:
    return float(getattr(next(e for e in model.elements() if e.name == element), name))


class AngleOffset(BenchEffect):
    """The axis stands `offset_deg` from where it says."""

    kind: Literal["angle_offset"] = "angle_offset"
    axis: str
    offset_deg: float = 0.0

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        return angles_deg | {self.axis: angles_deg[self.axis] + self.offset_deg}


class AngleScale(BenchEffect):
    """The axis turns 1 + `scale_error` times as far as it says."""

    kind: Literal["angle_scale"] = "angle_scale"
    axis: str
    scale_error: float = 0.0

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        return angles_deg | {self.axis: angles_deg[self.axis] * (1 + self.scale_error)}


class AngleWobble(BenchEffect):
    """Eccentric encoder or gear: a periodic error of `amplitude_deg`, `harmonic` periods a turn."""

    kind: Literal["angle_wobble"] = "angle_wobble"
    axis: str
    amplitude_deg: float = 0.0
    harmonic: int = 1
    phase_deg: float = 0.0

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        angle = angles_deg[self.axis]
        error = self.amplitude_deg * np.sin(np.deg2rad(self.harmonic * angle + self.phase_deg))
        return angles_deg | {self.axis: angle + float(error)}


class AngleJitter(BenchEffect):
    """Random positioning error of `sigma_deg` in each state."""

    kind: Literal["angle_jitter"] = "angle_jitter"
    axis: str
    sigma_deg: float = 0.0

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        error = self.sigma_deg * shot.random(f"jitter {self.axis}").standard_normal()
        return angles_deg | {self.axis: angles_deg[self.axis] + error}


class ElementError(BenchEffect):
    """An element's value (retardance_deg, azimuth_deg, extinction, ...) is off, and drifts."""

    kind: Literal["element_error"] = "element_error"
    element: str
    parameter: str = "retardance_deg"
    offset: float = 0.0
    per_hour: float = 0.0

    def train(self, model: InstrumentModel, shot: Shot) -> InstrumentModel:
        value = _value(model, self.element, self.parameter) + self.offset + self.per_hour * shot.time_s / 3600
        return with_element(model, self.element, **{self.parameter: value})


class SourceDrift(BenchEffect):
    """The lamp's level changes by a fraction an hour."""

    kind: Literal["source_drift"] = "source_drift"
    fraction_per_hour: float = 0.0

    def source(self, level: float, shot: Shot) -> float:
        return level * (1 + self.fraction_per_hour * shot.time_s / 3600)


class SourceFlicker(BenchEffect):
    """The lamp's level is random from exposure to exposure, relative standard deviation `sigma`."""

    kind: Literal["source_flicker"] = "source_flicker"
    sigma: float = 0.0

    def source(self, level: float, shot: Shot) -> float:
        return level * (1 + self.sigma * shot.random("flicker").standard_normal())


class SourceStep(BenchEffect):
    """The lamp jumps by a fraction at one exposure and stays there."""

    kind: Literal["source_step"] = "source_step"
    at_index: int = 0
    fraction: float = 0.0

    def source(self, level: float, shot: Shot) -> float:
        return level * (1 + self.fraction) if shot.index >= self.at_index else level


class ImageDrift(BenchEffect):
    """The image moves: steadily with time, and in a circle with an axis whose element is a wedge (pixels)."""

    kind: Literal["image_drift"] = "image_drift"
    rows_per_hour: float = 0.0
    columns_per_hour: float = 0.0
    axis: str | None = None
    wedge_pixels: float = 0.0

    def optics(self, electrons: Image, shot: Shot) -> Image:
        from scipy.ndimage import shift

        hours = shot.time_s / 3600
        rows, columns = self.rows_per_hour * hours, self.columns_per_hour * hours
        if self.axis is not None:
            turn = np.deg2rad(shot.angles_deg[self.axis])
            rows, columns = rows + self.wedge_pixels * np.sin(turn), columns + self.wedge_pixels * np.cos(turn)
        if rows == 0 and columns == 0:
            return electrons
        return np.asarray(shift(electrons, (rows, columns), order=1, mode="nearest"), dtype=np.float32)


class StrayLight(BenchEffect):
    """Light that never saw the polarization optics: electrons a second on every pixel, falling over the columns."""

    kind: Literal["stray_light"] = "stray_light"
    e_per_s: float = 0.0
    gradient: float = 0.0

    def optics(self, electrons: Image, shot: Shot) -> Image:
        ramp = 1 + self.gradient * np.linspace(-0.5, 0.5, electrons.shape[-1], dtype=np.float32)
        return np.asarray(electrons + self.e_per_s * shot.light * shot.exposure_s * ramp, dtype=np.float32)


class VeilingGlare(BenchEffect):
    """A fraction of the light of the whole image spreads evenly over it."""

    kind: Literal["veiling_glare"] = "veiling_glare"
    fraction: float = 0.0

    def optics(self, electrons: Image, shot: Shot) -> Image:
        mean = float(electrons.mean(dtype=np.float64))
        return np.asarray((1 - self.fraction) * electrons + self.fraction * mean, dtype=np.float32)


class MosaicCrosstalk(BenchEffect):
    """A fraction of each pixel's light is collected by its four neighbours, which on a mosaic look elsewhere."""

    kind: Literal["mosaic_crosstalk"] = "mosaic_crosstalk"
    fraction: float = 0.0

    def optics(self, electrons: Image, shot: Shot) -> Image:
        padded = np.pad(electrons, 1, mode="edge")
        neighbours = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
        return np.asarray((1 - self.fraction) * electrons + self.fraction / 4 * neighbours, dtype=np.float32)


class Nonlinearity(BenchEffect):
    """The response bends: electrons lose the fraction `at_full_scale` at `full_scale_e`, in proportion below."""

    kind: Literal["nonlinearity"] = "nonlinearity"
    at_full_scale: float = 0.0
    full_scale_e: float = 10_000.0

    def detector(self, electrons: Image, shot: Shot) -> Image:
        return np.asarray(electrons * (1 - self.at_full_scale * electrons / self.full_scale_e), dtype=np.float32)


class PixelResponse(BenchEffect):
    """Fixed pattern: each pixel's response differs, relative standard deviation `sigma`, the same in every frame."""

    kind: Literal["pixel_response"] = "pixel_response"
    sigma: float = 0.0

    def detector(self, electrons: Image, shot: Shot) -> Image:
        pattern = np.random.default_rng([shot.seed, zlib.crc32(b"pixel response")])
        return np.asarray(electrons * (1 + self.sigma * pattern.standard_normal(electrons.shape, dtype=np.float32)))


class UnevenLight(BenchEffect):
    """Uneven light on the field: it loses `corner_loss` towards the corners and grows by `gradient` over the rows."""

    kind: Literal["uneven_light"] = "uneven_light"
    corner_loss: float = Field(default=0.0, ge=0, lt=1)
    gradient: float = Field(default=0.0, gt=-1, lt=1)

    def optics(self, electrons: Image, shot: Shot) -> Image:
        y, x = (np.linspace(-1, 1, n, dtype=np.float32) for n in electrons.shape[-2:])
        loss = self.corner_loss * (x**2 + y[:, None] ** 2) / 2
        return np.asarray(electrons * (1 - loss + self.gradient * y[:, None] / 2), dtype=np.float32)


class BlackDrift(BenchEffect):
    """The black level moves by electrons an hour."""

    kind: Literal["black_drift"] = "black_drift"
    e_per_hour: float = 0.0

    def detector(self, electrons: Image, shot: Shot) -> Image:
        return np.asarray(electrons + np.float32(self.e_per_hour * shot.time_s / 3600))


AnyBenchEffect = Annotated[
    AngleOffset
    | AngleScale
    | AngleWobble
    | AngleJitter
    | ElementError
    | SourceDrift
    | SourceFlicker
    | SourceStep
    | ImageDrift
    | StrayLight
    | VeilingGlare
    | MosaicCrosstalk
    | Nonlinearity
    | PixelResponse
    | UnevenLight
    | BlackDrift,
    Field(discriminator="kind"),
]
