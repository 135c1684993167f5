"""Axes that do not stand where they say: offset, scale, wobble, jitter, slip, play."""

from typing import Literal

import numpy as np
from pydantic import Field, PrivateAttr

from simulators.bench.effects.base import BenchEffect, Shot


class AngleOffset(BenchEffect):
    """The axis stands `offset_deg` from where it says."""

    kind: Literal["angle_offset"] = "angle_offset"
    axis: str = Field(description="name of the axis")
    offset_deg: float = Field(default=0.0, description="how far the axis stands from where it says, degrees")

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        return angles_deg | {self.axis: angles_deg[self.axis] + self.offset_deg}


class AngleScale(BenchEffect):
    """The axis turns 1 + `scale_error` times as far as it says."""

    kind: Literal["angle_scale"] = "angle_scale"
    axis: str = Field(description="name of the axis")
    scale_error: float = Field(default=0.0, description="how much farther the axis turns than it says, relative")

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        return angles_deg | {self.axis: angles_deg[self.axis] * (1 + self.scale_error)}


class AngleWobble(BenchEffect):
    """Eccentric encoder or gear: a periodic error of `amplitude_deg`, `harmonic` periods a turn."""

    kind: Literal["angle_wobble"] = "angle_wobble"
    axis: str = Field(description="name of the axis")
    amplitude_deg: float = Field(default=0.0, description="amplitude, degrees")
    harmonic: int = Field(default=1, description="periods in one turn")
    phase_deg: float = Field(default=0.0, description="phase, degrees")

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        angle = angles_deg[self.axis]
        error = self.amplitude_deg * np.sin(np.deg2rad(self.harmonic * angle + self.phase_deg))
        return angles_deg | {self.axis: angle + float(error)}


class AngleJitter(BenchEffect):
    """Random positioning error of `sigma_deg` in each state."""

    kind: Literal["angle_jitter"] = "angle_jitter"
    axis: str = Field(description="name of the axis")
    sigma_deg: float = Field(default=0.0, description="standard deviation, degrees")

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        error = self.sigma_deg * shot.random(f"jitter {self.axis}").standard_normal()
        return angles_deg | {self.axis: angles_deg[self.axis] + error}


class AngleSlip(BenchEffect):
    """The axis slips by `slip_deg` on its shaft before exposure `at_index` and stays there."""

    kind: Literal["angle_slip"] = "angle_slip"
    axis: str = Field(description="name of the axis")
    at_index: int = Field(default=0, description="number of the exposure, from 0, from which on it holds")
    slip_deg: float = Field(default=0.0, description="how far the axis slips on its shaft, degrees")

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        if shot.index < self.at_index:
            return angles_deg
        return angles_deg | {self.axis: angles_deg[self.axis] + self.slip_deg}


class AnglePlay(BenchEffect):
    """Play in the gear: the shaft stays until the drive has turned by `play_deg` either way from its middle."""

    kind: Literal["angle_play"] = "angle_play"
    axis: str = Field(description="name of the axis")
    play_deg: float = Field(
        default=0.0, description="turn of the drive either way from its middle that does not move the shaft, degrees"
    )
    _shaft: float | None = PrivateAttr(default=None)

    def angles(self, angles_deg: dict[str, float], shot: Shot) -> dict[str, float]:
        drive = angles_deg[self.axis]
        before = drive - self.play_deg if self._shaft is None else self._shaft
        # The memory of the shaft is no part of the settings, which stay as they are.
        object.__setattr__(self, "_shaft", min(max(before, drive - self.play_deg), drive + self.play_deg))
        return angles_deg | {self.axis: float(self._shaft or 0.0)}
