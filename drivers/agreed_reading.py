"""A number read over a line without checksum: readings have to agree before one is believed."""

from collections.abc import Callable

from drivers.clock import REAL, Clock
from drivers.errors import ReplyError

# On a line that was disturbed this short a time ago, two garbled replies may be equal.
_MEMORY_S = 60.0
_CALM, _DISTURBED = 2, 4
_TRIES = 6


class AgreeingReadings:
    """Reads a position until readings agree: two in a row on a calm line, four on one that was disturbed lately.

    A dropped digit looks like a position, and at one byte in ten the same digit is dropped twice in a thousand
    readings.
    """

    def __init__(self, clock: Clock = REAL) -> None:
        self._clock = clock
        self._disturbed_s = -float("inf")

    def read(
        self, request: str, read: Callable[[], float], is_moving: Callable[[], bool], tolerance: float
    ) -> tuple[float, bool]:
        """Return the number, and False if it is that of an axis in motion.

        Parameters
        ----------
        request : name of the reading, for the error.
        read, is_moving : ask the device.
        tolerance : by how much readings of a servo at rest may tremble.

        Raises
        ------
        ReplyError
            Readings at rest contradict each other.
        """
        try:
            return self._read(request, read, is_moving, tolerance)
        except ReplyError:
            self._disturbed_s = self._clock.now_s()
            raise

    def _read(
        self, request: str, read: Callable[[], float], is_moving: Callable[[], bool], tolerance: float
    ) -> tuple[float, bool]:
        disturbed = self._clock.now_s() - self._disturbed_s < _MEMORY_S
        agreement = _DISTURBED if disturbed else _CALM
        readings, moving = [read()], 0
        while len(readings) < _TRIES * (agreement - 1):
            readings.append(read())
            if len(readings) >= agreement and len(set(readings[-agreement:])) == 1:
                return readings[-1], True
            if readings[-1] == readings[-2]:
                continue
            # A servo trembles within the tolerance, and so can a changed last digit: the middle is right.
            window = sorted(readings[-2 * agreement + 1 :])
            middle = window[len(window) // 2]
            if len(window) == 2 * agreement - 1 and window[-1] - window[0] <= tolerance:
                return middle, True
            # In motion readings differ. One reply that says "moving" may itself be the disturbed one.
            moving = moving + 1 if is_moving() else 0
            if moving == 3:
                return middle, False
            if moving == 0 and abs(readings[-1] - readings[-2]) > tolerance:
                self._disturbed_s = self._clock.now_s()
                agreement = _DISTURBED
        raise ReplyError(
            request,
            f"readings at rest that contradict each other: {readings}",
            "The line is disturbed: check cable, grounding and baud rate",
        )
