"""What a file holds, as one number, without reading the frames of a capture: their checksums stand for them."""

import hashlib
from pathlib import Path

import h5py
import numpy as np

from processing.storage.integrity.checksums import NONE
from processing.storage.integrity.h5_door import DAMAGE, mark_of

#: Bytes read at once.
PIECE = 1 << 20


def without_frames_sha256(path: Path) -> str | None:
    """SHA-256 (hex) of all bytes of a capture but those of its frames.

    Among them are the CRC-32 of each row of each frame. Whoever reads a frame holds it against them, so a capture with
    other frames that can be read has other bytes here as well (but for the chance of 2^-32 for each row that differs).

    Returns
    -------
    None for a file that is no capture, is damaged, or has states without checksums.
    """
    if mark_of(path, "umov_schema") is None:
        return None
    try:
        frames = _places_of_summed_frames(path)
    except DAMAGE:
        return None
    if not frames:
        return None
    digest = hashlib.sha256()
    with path.open("rb") as file:
        for offset, size in [*sorted(frames), (path.stat().st_size, 0)]:
            while piece := file.read(min(PIECE, offset - file.tell())):
                digest.update(piece)
            file.seek(offset + size)
    return digest.hexdigest()


def _places_of_summed_frames(path: Path) -> list[tuple[int, int]]:
    """First byte and number of bytes of each chunk of the frames; none if a state has no checksum. Raises DAMAGE."""
    places: list[tuple[int, int]] = []
    with h5py.File(path, "r") as h5:
        states = h5["entry/states"]
        if "crc32" in states and not np.any(states["crc32"][...][states["done"][...] != 0] == NONE):
            frames = h5["entry/instrument/detector/data"]
            frames.id.chunk_iter(lambda chunk: places.append((chunk.byte_offset, chunk.size)))
    return places
