"""More of what a real bench does that its declared model does not: plates, play, slips, bent counts.

The first half is in bench_effects.py. The name of each `diagnose` effect's switch is in docs/adding-an-effect.md.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, PrivateAttr

from processing.instrument.model import InstrumentModel, Retarder
from simulators.bench.effects import AnyBenchEffect, BenchEffect, Image, Shot, with_element


class Window(BenchEffect):
    """A plate under stress behind an element of the generator: linear retardance that nobody declared.

    Behind the polarizer at 45 degrees it makes the light elliptic, by half of its retardance.
    """

    kind: Literal["window"] = "window"
    behind: str
    azimuth_deg: float = 45.0
    retardance_deg: float = 0.0

    def train(self, model: InstrumentModel, shot: Shot) -> InstrumentModel:
        names = [e.name for e in model.generator]
        if self.behind not in names:
            raise KeyError(f"instrument {model.name!r} has no element {self.behind!r} in its generator")
        plate = Retarder(
            kind="retarder", name="window", azimuth_deg=self.azimuth_deg, retardance_deg=self.retardance_deg
        )
        at = names.index(self.behind) + 1
        return model.model_copy(update={"generator": (*model.generator[:at], plate, *model.generator[at:])})


class PlateTransmission(BenchEffect):
    """What an axis turns passes more light at some angles: a wedge or a stain (once a turn), s against p (twice)."""

    kind: Literal["plate_transmission"] = "plate_transmission"
    axis: str
    amplitude: float = 0.0
    harmonic: int = 1
    phase_deg: float = 0.0

    def source(self, level: float, shot: Shot) -> float:
        angle = np.deg2rad(self.harmonic * shot.angles_deg[self.axis] - self.phase_deg)
        return level * (1 + self.amplitude * float(np.cos(angle)))


class FieldRetardance(BenchEffect):
    """Rays meet a plate at an angle: its retardance grows with the square of the distance from a centre.

    `edge_deg` is what is added at half the image width from the centre (`x`, `y`; -1 to 1 over the image).
    """

    kind: Literal["field_retardance"] = "field_retardance"
    element: str
    edge_deg: float = 0.0
    x: float = 0.0
    y: float = 0.0

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


class AngleSlip(BenchEffect):
    """The axis slips by `slip_deg` on its shaft before exposure `at_index` and stays there."""

    kind: Literal["angle_slip"] = "angle_slip"
    axis: str
    at_index: int = 0
    slip_deg: float = 0.0

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        if shot.index < self.at_index:
            return angles_deg
        return angles_deg | {self.axis: angles_deg[self.axis] + self.slip_deg}


class AnglePlay(BenchEffect):
    """Play in the gear: the shaft stays until the drive has turned by `play_deg` either way from its middle."""

    kind: Literal["angle_play"] = "angle_play"
    axis: str
    play_deg: float = 0.0
    _shaft: float | None = PrivateAttr(default=None)

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        drive = angles_deg[self.axis]
        before = drive - self.play_deg if self._shaft is None else self._shaft
        # What the shaft remembers is its own business, not part of the settings, which stay as they are.
        object.__setattr__(self, "_shaft", min(max(before, drive - self.play_deg), drive + self.play_deg))
        return angles_deg | {self.axis: float(self._shaft or 0.0)}


class ChannelError(BenchEffect):
    """One channel passes `gain` times what it should."""

    kind: Literal["channel_error"] = "channel_error"
    channel: str
    gain: float = 1.0

    def train(self, model: InstrumentModel, shot: Shot) -> InstrumentModel:
        if self.channel not in {c.name for c in model.channels}:
            raise KeyError(f"instrument {model.name!r} has no channel {self.channel!r}")
        channels = tuple(
            c.model_copy(update={"gain": c.gain * self.gain}) if c.name == self.channel else c for c in model.channels
        )
        return model.model_copy(update={"channels": channels})


class BlackOffset(BenchEffect):
    """The black level is `electrons` above what the header says."""

    kind: Literal["black_offset"] = "black_offset"
    electrons: float = 0.0

    def detector(self, electrons: Image, shot: Shot) -> Image:
        return np.asarray(electrons + np.float32(self.electrons))


class ToneCurve(BenchEffect):
    """The camera stores a power of the light: its contrast setting is not 1."""

    kind: Literal["tone_curve"] = "tone_curve"
    gamma: float = 1.0
    full_scale_e: float = 10_000.0

    def detector(self, electrons: Image, shot: Shot) -> Image:
        share = np.maximum(electrons, 0) / self.full_scale_e
        return np.asarray(self.full_scale_e * share ** (1 / self.gamma), dtype=np.float32)


class SourceLevel(BenchEffect):
    """The source gives `factor` times its light: enough of it saturates the detector."""

    kind: Literal["source_level"] = "source_level"
    factor: float = 1.0

    def source(self, level: float, shot: Shot) -> float:
        return level * self.factor


AnyBenchFault = Annotated[
    AnyBenchEffect
    | Window
    | PlateTransmission
    | FieldRetardance
    | AngleSlip
    | AnglePlay
    | ChannelError
    | BlackOffset
    | ToneCurve
    | SourceLevel,
    Field(discriminator="kind"),
]
