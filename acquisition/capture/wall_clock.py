"""Notices that the machine's clock was set, or that the machine slept, while a capture runs.

Deadlines count on clocks that cannot be set. The time of day is only for the record, and there it continues from the
start of the run, as if the clock had not been set: the order and the distances in time of the states stay right.
"""

import time
from dataclasses import dataclass

#: A time server that steps the clock steps it by more than this; what it slews between two looks is far less.
STEP_S = 0.1
#: The clocks are not read at one instant: read again if the reading itself took longer.
READING_S = 0.005


@dataclass(frozen=True)
class Clocks:
    """One look at the machine's clocks, seconds: time of day, since start-up with sleep and without."""

    unix_s: float
    with_sleep_s: float
    awake_s: float


def read_clocks() -> Clocks:
    """Read all of them as nearly at once as the machine allows."""
    for _ in range(20):
        start_s = time.clock_gettime(time.CLOCK_MONOTONIC)
        clocks = Clocks(time.time(), time.clock_gettime(time.CLOCK_BOOTTIME), time.clock_gettime(time.CLOCK_MONOTONIC))
        if clocks.awake_s - start_s < READING_S:
            break
    return clocks


class WallClock:
    """The time of day as it was when this was made, going on evenly.

    Attributes
    ----------
    ahead_s : how far the machine's clock is ahead of that now, after it was set.
    """

    def __init__(self) -> None:
        self._first = self._last = read_clocks()
        self.ahead_s = 0.0

    def look(self) -> str | None:
        """What has happened since the last look, in words; None if nothing has."""
        now, last, first = read_clocks(), self._last, self._first
        self._last = now
        self.ahead_s = (now.unix_s - now.with_sleep_s) - (first.unix_s - first.with_sleep_s)
        slept_s = (now.with_sleep_s - now.awake_s) - (last.with_sleep_s - last.awake_s)
        if slept_s > STEP_S:
            return f"the machine slept for {slept_s:.1f} s"
        step_s = (now.unix_s - now.with_sleep_s) - (last.unix_s - last.with_sleep_s)
        if abs(step_s) > STEP_S:
            return f"the machine's clock was set {'forward' if step_s > 0 else 'back'} by {abs(step_s):.1f} s"
        return None
