"""Axes that do not stand where they say: offset, scale, wobble, jitter, slip, play."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import PrivateAttr

from simulators.bench.effects.base import BenchEffect, Shot


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
