"""Numbers written into the first pixels of an image, so that a frame can testify when it was taken."""

import struct
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_MAGIC = 0xA5


def stamp(pixels: NDArray[np.uint16], values: Sequence[float], bits: int = 12) -> None:
    """Write float values into the first pixels, row by row, four bits a pixel.

    Each pixel gets the middle of one of 16 equal steps of the full scale, so a disturbance of less than
    2**bits / 32 counts does not change what is read. A checksum tells a stamp from a picture.

    Parameters
    ----------
    pixels : ndarray of uint16
        Image, changed in place; needs ``16 * len(values) + 12`` pixels.
    values : up to 255 numbers; read back exactly.
    bits : bits of the counts, at least 5.

    Raises
    ------
    ValueError
        The image is too small.
    """
    body = struct.pack(f"<BB{len(values)}d", _MAGIC, len(values), *values)
    message = np.frombuffer(body + struct.pack("<I", zlib.crc32(body)), np.uint8)
    nibbles = np.stack([message >> 4, message & 0xF], axis=1).ravel().astype(np.uint16)
    if nibbles.size > pixels.size:
        raise ValueError(f"a stamp of {len(values)} numbers needs {nibbles.size} pixels, the image has {pixels.size}")
    step = 1 << (bits - 4)
    pixels.flat[: nibbles.size] = nibbles * step + step // 2


def read_stamp(pixels: NDArray[np.uint16], bits: int = 12) -> tuple[float, ...]:
    """Read the numbers that `stamp` wrote. Raises ValueError: there is no stamp, or it was disturbed."""
    count = int(_read_bytes(pixels, 2, bits)[1])
    length = 2 + 8 * count + 4
    if 2 * length > pixels.size:
        raise ValueError("no stamp in this image")
    message = _read_bytes(pixels, length, bits)
    body, checksum = message[:-4], struct.unpack("<I", message[-4:])[0]
    if body[0] != _MAGIC or zlib.crc32(body) != checksum:
        raise ValueError("no stamp in this image, or it was disturbed")
    return struct.unpack(f"<{count}d", body[2:])


def _read_bytes(pixels: NDArray[np.uint16], count: int, bits: int) -> bytes:
    nibbles = np.minimum(np.asarray(pixels.flat[: 2 * count], np.uint16) >> (bits - 4), 15).astype(np.uint8)
    if nibbles.size < 2 * count:
        raise ValueError("no stamp in this image: it is too small")
    return bytes(nibbles[0::2] << 4 | nibbles[1::2])
