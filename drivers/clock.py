"""The clock that drivers count their deadlines and pauses by; it comes in with the ports, as real time by default."""

import time
from typing import Protocol


class Clock(Protocol):
    """Seconds from any zero that never run backwards, and a pause counted in the same seconds."""

    def now_s(self) -> float:
        """Seconds since this clock's zero."""

    def sleep_s(self, duration_s: float) -> None:
        """Wait; not at all if `duration_s` is not positive."""


class RealClock:
    """The machine's own monotonic clock, for devices that keep time by themselves."""

    def now_s(self) -> float:
        """Seconds since the machine was started."""
        return time.monotonic()

    def sleep_s(self, duration_s: float) -> None:
        """Wait; not at all if `duration_s` is not positive."""
        time.sleep(max(0.0, duration_s))


REAL = RealClock()
