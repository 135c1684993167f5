"""Where an HDF5 file keeps its texts: a damage there that the library follows for ever is found before it is asked.

A global heap collection ("GCOL", HDF5 file format specification III.E) is a row of objects, each with its size; the
free space at its end is object 0. A free space of no size makes HDF5 2.0 read the same place again and again
(HDFGroup/hdf5 issue 1707), which neither a limit nor Ctrl-C ends.
"""

import os
import struct
from pathlib import Path

#: Texts of captures and products stand near the ends of a file, before and after its numbers.
NEAR_AN_END = 1 << 20
_MARK = b"GCOL\x01\x00\x00\x00"
_OBJECT = struct.Struct("<HHIQ")


def endless_heap(path: Path) -> int | None:
    """Byte at which a heap begins that HDF5 would read for ever, in the first and last MiB; None if there is none."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        starts = {0, max(0, size - NEAR_AN_END)}
        for start in sorted(starts):
            file.seek(start)
            part = file.read(NEAR_AN_END)
            place = part.find(_MARK)
            while place >= 0:
                if _endless(part, place):
                    return start + place
                place = part.find(_MARK, place + 1)
    return None


def _endless(part: bytes, place: int) -> bool:
    header = place + len(_MARK)
    length = int.from_bytes(part[header : header + 8], "little")
    at, end = header + 8, min(place + length, len(part))
    while at + _OBJECT.size <= end:
        index, _, _, size = _OBJECT.unpack_from(part, at)
        if index == 0:
            return bool(size == 0)
        at += _OBJECT.size + (size + 7) // 8 * 8
    return False
