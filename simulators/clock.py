"""Time for simulators: real, faster than real, or instant; and the trapezoid on which a motor moves."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass


class Clock:
    """Simulated time that runs `speed` times as fast as real time.

    Parameters
    ----------
    speed : float
        Simulated seconds per real second.
    instant : bool
        Motions take no time at all; the clock itself runs on.
    """

    def __init__(self, speed: float = 1.0, instant: bool = False) -> None:
        if not (math.isfinite(speed) and speed > 0):
            raise ValueError(f"clock speed must be positive and finite, not {speed}")
        self.speed = speed
        self.instant = instant
        self._start_s = time.monotonic()

    def now_s(self) -> float:
        """Simulated seconds since the clock was made."""
        return (time.monotonic() - self._start_s) * self.speed

    def sleep_s(self, duration_s: float) -> None:
        """Wait for `duration_s` simulated seconds."""
        if not self.instant:
            time.sleep(max(0.0, duration_s) / self.speed)


class ManualClock(Clock):
    """A clock that only moves when it is told to, for tests that look at one instant."""

    def __init__(self) -> None:
        super().__init__()
        self._now_s = 0.0

    def now_s(self) -> float:
        """Simulated seconds advanced so far."""
        return self._now_s

    def sleep_s(self, duration_s: float) -> None:
        """Advance by `duration_s` at once."""
        self._now_s += max(0.0, duration_s)


@dataclass(frozen=True, slots=True)
class TrapezoidMotion:
    """Position in time of a motor that accelerates, runs, and brakes with the same constant acceleration.

    Short moves never reach `speed` and are triangular. Any length unit; `speed` and `acceleration` positive,
    `math.inf` for a jump.
    """

    start: float
    target: float
    speed: float
    acceleration: float
    start_s: float = 0.0

    @property
    def ramp_s(self) -> float:
        """Duration of either ramp."""
        if math.isinf(self.acceleration):
            return 0.0
        return min(self.speed / self.acceleration, math.sqrt(abs(self.target - self.start) / self.acceleration))

    @property
    def peak_speed(self) -> float:
        """Highest speed reached."""
        return self.speed if math.isinf(self.acceleration) else self.ramp_s * self.acceleration

    @property
    def duration_s(self) -> float:
        """Time from start to rest."""
        distance = abs(self.target - self.start)
        if distance == 0 or math.isinf(self.peak_speed):
            return 0.0
        return distance / self.peak_speed + self.ramp_s

    def position(self, now_s: float) -> float:
        """Position at `now_s`; exactly `start` before and exactly `target` after the motion."""
        t = now_s - self.start_s
        duration_s = self.duration_s
        if t >= duration_s:
            return self.target
        if t <= 0:
            return self.start
        sign = math.copysign(1.0, self.target - self.start)
        ramp_s, peak = self.ramp_s, self.peak_speed
        if t < ramp_s:
            return self.start + sign * 0.5 * self.acceleration * t * t
        if t <= duration_s - ramp_s:
            return self.start + sign * peak * (t - 0.5 * ramp_s)
        left_s = duration_s - t
        return self.target - sign * 0.5 * self.acceleration * left_s * left_s

    def velocity(self, now_s: float) -> float:
        """Signed velocity at `now_s`; zero before and after the motion."""
        t = now_s - self.start_s
        duration_s = self.duration_s
        if t <= 0 or t >= duration_s:
            return 0.0
        sign = math.copysign(1.0, self.target - self.start)
        if math.isinf(self.acceleration):
            return sign * self.peak_speed
        return sign * min(self.peak_speed, self.acceleration * t, self.acceleration * (duration_s - t))
