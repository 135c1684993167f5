"""Mitsuba's tensor file: named arrays in one binary file, as the reader in its source (core/tensor.cpp) wants them."""

import math
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.doors import require_file
from processing.errors import ProcessError

MAGIC = b"tensor_file\0"
VERSION = (1, 0)
#: Codes of the renderer's Struct::Type.
TYPES: dict[int, Any] = {
    1: np.uint8,
    2: np.int8,
    3: np.uint16,
    4: np.int16,
    5: np.uint32,
    6: np.int32,
    7: np.uint64,
    8: np.int64,
    9: np.float16,
    10: np.float32,
    11: np.float64,
}


#: A pBRDF has 5 fields of up to 6 dimensions.
MOST_FIELDS = 64
MOST_DIMENSIONS = 16


class TensorFileError(ProcessError):
    """A tensor file cannot be read."""


def create_tensor_file(path: Path, fields: Mapping[str, tuple[tuple[int, ...], Any]]) -> dict[str, NDArray[Any]]:
    """Lay out a file with the fields (shape, type) and return them as writable memory maps."""
    codes = {np.dtype(t): code for code, t in TYPES.items()}
    header = sum(2 + len(name.encode()) + 2 + 1 + 8 + 8 * len(shape) for name, (shape, _) in fields.items())
    offset = len(MAGIC) + 2 + 4 + header
    entries, places = bytearray(), {}
    for name, (shape, kind) in fields.items():
        dtype = np.dtype(kind)
        offset = -(-offset // dtype.itemsize) * dtype.itemsize
        encoded = name.encode()
        entries += struct.pack(f"<H{len(encoded)}sHBQ", len(encoded), encoded, len(shape), codes[dtype], offset)
        entries += struct.pack(f"<{len(shape)}Q", *shape)
        places[name] = (offset, shape, dtype)
        offset += int(np.prod(shape)) * dtype.itemsize
    with path.open("wb") as file:
        file.write(MAGIC + struct.pack("<BBI", *VERSION, len(fields)) + entries)
        file.truncate(offset)
    return {n: np.memmap(path, dtype=d, mode="r+", offset=o, shape=s) for n, (o, s, d) in places.items()}


def read_tensor_file(path: Path) -> dict[str, NDArray[Any]]:
    """Fields of a tensor file as read-only memory maps. Raises TensorFileError."""
    try:
        size = require_file(path, TensorFileError)
        with path.open("rb") as file:
            if file.read(12) != MAGIC:
                raise TensorFileError(f"{path} is no tensor file: its first bytes are not 'tensor_file'.")
            major, minor, count = struct.unpack("<BBI", file.read(6))
            if major != VERSION[0]:
                raise TensorFileError(f"{path} has tensor file version {major}.{minor}; this program reads 1.x.")
            if count > MOST_FIELDS:
                raise TensorFileError(f"{path} promises {count} fields; at most {MOST_FIELDS} are read.")
            places = {}
            for _ in range(count):
                (length,) = struct.unpack("<H", file.read(2))
                name = file.read(length).decode()
                dimensions, code, offset = struct.unpack("<HBQ", file.read(11))
                shape = struct.unpack(f"<{dimensions}Q", file.read(8 * dimensions))
                places[name] = (shape, np.dtype(TYPES[code]), offset)
    except (OSError, struct.error, UnicodeDecodeError, KeyError) as error:
        raise TensorFileError(
            f"{path} cannot be read as a tensor file ({error}); it is truncated or damaged."
        ) from error
    for name, (shape, dtype, offset) in places.items():
        if 0 in shape or len(shape) > MOST_DIMENSIONS:
            raise TensorFileError(f"{path}: field {name!r} has the shape {shape[:MOST_DIMENSIONS]}; it holds nothing.")
        if offset + math.prod(shape) * dtype.itemsize > size:
            raise TensorFileError(f"{path} is truncated: field {name!r} ends beyond its {size} bytes.")
    return {n: np.memmap(path, dtype=d, mode="r", offset=o, shape=s) for n, (s, d, o) in places.items()}
