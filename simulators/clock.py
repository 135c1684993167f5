"""Time for simulators: real or patient, faster, or instant; and the trapezoid on which a motor moves."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property

from drivers import clock as driver_clock

#: Who attends the patient clock looks at it this often; it runs no further than this past the last time that all did.
BEAT_S = 0.01
LONGEST_BEAT_S = 0.02


class PatientClock:
    """Real time without the gaps in which part of this process was kept from running.

    Every thread that others wait for says all the time that it is there (`attend`). The clock goes on when all of them
    have, by `LONGEST_BEAT_S` at most. A driver and the emulator that it talks to then lose the same time on a busy
    machine: what is in time on a quiet one is in time there too, and a deadline that passes has really been missed.

    Parameters
    ----------
    real_s : real time in seconds.
    """

    def __init__(self, real_s: Callable[[], float] = time.monotonic) -> None:
        self._real_s = real_s
        self._lock = threading.Lock()
        self._counted_s = 0.0
        self._all_there_s = real_s()
        # Whether each thread that attends has been there since then.
        self._is_present: dict[object, bool] = {}

    @contextmanager
    def attend(self) -> Iterator[Callable[[], None]]:
        """Give a function to call every `BEAT_S`; the clock waits for the thread that does until the block ends."""
        key = object()

        def check_in() -> None:
            with self._lock:
                self._is_present[key] = True
                self._go_on()

        with self._lock:
            self._is_present[key] = False
        try:
            yield check_in
        finally:
            with self._lock:
                del self._is_present[key]
                self._go_on()

    def now_s(self) -> float:
        """Seconds counted since the clock was made."""
        with self._lock:
            return self._counted_s + min(self._real_s() - self._all_there_s, LONGEST_BEAT_S)

    def sleep_s(self, duration_s: float) -> None:
        """Wait until so many seconds were counted; not at all if `duration_s` is not positive."""
        end_s = self.now_s() + duration_s
        while (left_s := end_s - self.now_s()) > 0:
            time.sleep(left_s)

    def _go_on(self) -> None:
        if all(self._is_present.values()):
            real_s = self._real_s()
            self._counted_s += min(real_s - self._all_there_s, LONGEST_BEAT_S)
            self._all_there_s = real_s
            self._is_present = dict.fromkeys(self._is_present, False)


@cache
def patient_clock() -> PatientClock:
    """The patient clock of this process, kept going by a thread."""
    clock = PatientClock()

    def keep_going() -> None:
        with clock.attend() as check_in:
            while True:
                time.sleep(BEAT_S)
                check_in()

    threading.Thread(target=keep_going, name="patient clock", daemon=True).start()
    return clock


class FastClock:
    """Simulated time that runs `speed` times as fast as the clock it is based on.

    Parameters
    ----------
    speed : simulated seconds per second of `base`.
    instant : motions take no time at all; the clock itself runs on.
    base : drivers.clock.Clock
        Clock of the drivers that talk to this simulator; real time by default, for clients of any origin.
    """

    def __init__(self, speed: float = 1.0, instant: bool = False, base: driver_clock.Clock = driver_clock.REAL) -> None:
        if not (math.isfinite(speed) and speed > 0):
            raise ValueError(f"clock speed must be positive and finite, not {speed}")
        self.speed = speed
        self.instant = instant
        self.base = base
        self._start_s = base.now_s()

    def now_s(self) -> float:
        """Simulated seconds since the clock was made."""
        return (self.base.now_s() - self._start_s) * self.speed

    def sleep_s(self, duration_s: float) -> None:
        """Wait for `duration_s` simulated seconds."""
        if not self.instant:
            self.base.sleep_s(duration_s / self.speed)


class ManualClock(FastClock):
    """A clock that only moves by `sleep_s`, for tests that look at one instant."""

    def __init__(self) -> None:
        super().__init__()
        self._now_s = 0.0

    def now_s(self) -> float:
        """Simulated seconds advanced so far."""
        return self._now_s

    def sleep_s(self, duration_s: float) -> None:
        """Advance by `duration_s` at once."""
        self._now_s += max(0.0, duration_s)


@dataclass(frozen=True)
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

    @cached_property
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
