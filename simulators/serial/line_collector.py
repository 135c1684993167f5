"""Bytes as they come, in portions of any size, put together to lines of text."""

from collections.abc import Iterator

#: Bytes that a controller keeps of a line that does not end.
MOST = 256


class LineCollector:
    """The bytes of a line that an emulator has received.

    Parameters
    ----------
    ends : bytes of which each ends a line.
    """

    def __init__(self, ends: bytes = b"\r\n") -> None:
        self._ends = ends
        self._line = bytearray()

    def lines(self, data: bytes) -> Iterator[str]:
        """Lines that end in these bytes, without their ends; empty ones as well."""
        for byte in data:
            if byte in self._ends:
                line, self._line = bytes(self._line), bytearray()
                yield line.decode("latin-1")
            elif len(self._line) < MOST:
                self._line.append(byte)
