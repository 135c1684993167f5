"""Optics that are not as declared: elements, plates, channels, retardance that varies over the image."""

from collections.abc import Callable
from typing import Literal

import numpy as np
from pydantic import Field

from processing.arrays import Image
from processing.instrument.elements import number
from processing.instrument.model import InstrumentModel, Retarder
from simulators.bench.effects.base import BenchEffect, Shot, with_element


def _value(model: InstrumentModel, element: str, name: str) -> float:
    return float(getattr(next(e for e in model.elements() if e.name == element), name))


class ElementError(BenchEffect):
    """An element's value (retardance_deg, azimuth_deg, extinction, ...) is off, and drifts."""

    kind: Literal["element_error"] = "element_error"
    element: str = Field(description="name of the element in the instrument file")
    parameter: str = Field(
        default="retardance_deg", description="value that is off: retardance_deg, azimuth_deg, extinction, ..."
    )
    offset: float = Field(default=0.0, description="what is added to it, in its own unit")
    per_hour: float = Field(default=0.0, description="what is added to it in an hour, in its own unit")

    def train(self, model: InstrumentModel, shot: Shot) -> InstrumentModel:
        value = _value(model, self.element, self.parameter) + self.offset + self.per_hour * shot.time_s / 3600
        return with_element(model, self.element, **{self.parameter: value})


class WindowPlate(BenchEffect):
    """A plate under stress behind an element of the generator: linear retardance that nobody declared.

    Behind the polarizer at 45 degrees it makes the light elliptic, by half of its retardance.
    """

    kind: Literal["window"] = "window"
    behind: str = Field(description="element of the generator that it stands behind")
    azimuth_deg: float = Field(default=45.0, description="azimuth of its fast axis, degrees from +x towards +y")
    retardance_deg: float = Field(default=0.0, description="retardance, degrees")

    def train(self, model: InstrumentModel, shot: Shot) -> InstrumentModel:
        names = [e.name for e in model.generator]
        if self.behind not in names:
            raise KeyError(f"instrument {model.name!r} has no element {self.behind!r} in its generator")
        plate = Retarder(
            kind="retarder", name="window", azimuth_deg=self.azimuth_deg, retardance_deg=self.retardance_deg
        )
        index = names.index(self.behind) + 1
        return model.model_copy(update={"generator": (*model.generator[:index], plate, *model.generator[index:])})


class PlateTransmission(BenchEffect):
    """What an axis turns passes more light at some angles: a wedge or a stain (once a turn), s against p (twice)."""

    kind: Literal["plate_transmission"] = "plate_transmission"
    axis: str = Field(description="name of the axis")
    amplitude: float = Field(default=0.0, description="relative amplitude")
    harmonic: int = Field(default=1, description="periods in one turn")
    phase_deg: float = Field(default=0.0, description="phase, degrees")

    def source(self, level: float, shot: Shot) -> float:
        angle = np.deg2rad(self.harmonic * shot.angles_deg[self.axis] - self.phase_deg)
        return level * (1 + self.amplitude * float(np.cos(angle)))


class PlateRetardance(BenchEffect):
    """A plate with a wedge, met beside its axis: its retardance goes up and down once a turn."""

    kind: Literal["plate_retardance"] = "plate_retardance"
    element: str = Field(description="name of the element in the instrument file")
    amplitude_deg: float = Field(default=0.0, description="amplitude, degrees")
    phase_deg: float = Field(default=0.0, description="phase, degrees")

    def train(self, model: InstrumentModel, shot: Shot) -> InstrumentModel:
        declared = _value(model, self.element, "retardance_deg")
        plate = next(e for e in model.elements() if e.name == self.element)
        if plate.axis is None:
            raise KeyError(f"{self.element!r} does not turn")
        phase = np.deg2rad(plate.ratio * shot.angles_deg[plate.axis] - self.phase_deg)
        return with_element(model, self.element, retardance_deg=declared + self.amplitude_deg * float(np.cos(phase)))


class FieldRetardanceFault(BenchEffect):
    """Rays meet a plate at an angle: its retardance grows with the square of the distance from a centre.

    `edge_deg` is what is added at half the image width from the centre (`x`, `y`; -1 to 1 over the image).
    """

    kind: Literal["field_retardance"] = "field_retardance"
    element: str = Field(description="name of the element in the instrument file")
    edge_deg: float = Field(
        default=0.0, description="retardance added at half the image width from the centre, degrees"
    )
    x: float = Field(default=0.0, description="centre across the image, -1 (left) to 1")
    y: float = Field(default=0.0, description="centre down the image, -1 (top) to 1")

    def field(self, image: Image, model: InstrumentModel, seen: Callable[[InstrumentModel], Image]) -> Image:
        if self.edge_deg == 0:
            return image
        # Light behind a retarder is A + B cos d + C sin d: three retardances tell A, B and C of every pixel.
        at_0, at_90, at_180 = (seen(with_element(model, self.element, retardance_deg=d)) for d in (0.0, 90.0, 180.0))
        declared = next(e for e in model.elements() if e.name == self.element)
        if not isinstance(declared, Retarder):
            raise KeyError(f"{self.element!r} is not a retarder")
        rows, columns = image.shape[-2:]
        y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j]
        distance = (x - self.x) ** 2 + (y - self.y) ** 2
        if isinstance(declared.retardance_deg, dict):
            raise KeyError(f"the model of {self.element!r} is not resolved at a wavelength")
        d = np.deg2rad(declared.retardance_deg + self.edge_deg * distance)
        mean, swing = (at_0 + at_180) / 2, (at_0 - at_180) / 2
        return np.asarray(mean + swing * np.cos(d) + (at_90 - mean) * np.sin(d), dtype=np.float32)


class ChannelError(BenchEffect):
    """One channel passes `gain` times what it should."""

    kind: Literal["channel_error"] = "channel_error"
    channel: str = Field(description="name of the channel")
    gain: float = Field(default=1.0, description="factor on the channel")

    def train(self, model: InstrumentModel, shot: Shot) -> InstrumentModel:
        if self.channel not in {c.name for c in model.channels}:
            raise KeyError(f"instrument {model.name!r} has no channel {self.channel!r}")
        channels = tuple(
            c.model_copy(update={"gain": number(c.gain) * self.gain}) if c.name == self.channel else c
            for c in model.channels
        )
        return model.model_copy(update={"channels": channels})
