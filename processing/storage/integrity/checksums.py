"""Checksums of a capture: one for each row of each frame, one for all other values of a state.

They are written once, with the state, and verified wherever the state is read. A row has its own so that a reader of a
few rows need not read the whole frame.
"""

from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

#: In the column `crc32`: this state has none (made by an older version, or synthetic).
NONE = -1
#: Columns that are no part of a state's checksum: the mark that it is there, the checksum itself, and texts.
UNSUMMED = ("done", "crc32", "role")


def row_crc32(frame: NDArray[Any]) -> NDArray[np.uint32]:
    """CRC-32 of each row's bytes; `frame` is (..., rows, columns), the result (..., rows)."""
    lines = np.ascontiguousarray(frame).reshape(-1, frame.shape[-1])
    sums = np.fromiter((isal_zlib.crc32(line) for line in lines), dtype=np.uint32, count=len(lines))
    return sums.reshape(frame.shape[:-1])


def state_crc32(row_sums: NDArray[np.uint32], values: Mapping[str, np.generic]) -> int:
    """CRC-32 of a state: the checksums of its rows, then the bytes of its values in the order of their names."""
    total = isal_zlib.crc32(np.ascontiguousarray(row_sums).data)
    for name in sorted(values):
        total = isal_zlib.crc32(values[name].tobytes(), isal_zlib.crc32(name.encode(), total))
    return total


def summed_values(entry: h5py.Group) -> dict[str, NDArray[Any]]:
    """What the checksum of a state covers besides its frame: columns and angles, each for all planned states."""
    values = {name: column[...] for name, column in entry["states"].items() if name not in UNSUMMED}
    for axis, group in entry["instrument"].items():
        if group.attrs.get("NX_class") == "NXpositioner":
            values |= {f"{axis}/{name}": group[name][...] for name in ("value", "raw_value")}
    return values


def write_checksums(entry: h5py.Group, row_sums: NDArray[np.uint32]) -> None:
    """Write the checksums of a capture whose states are all in the file.

    Parameters
    ----------
    row_sums : of the frames (states, channels, rows), as they were handed to the file.
    """
    entry["instrument/detector/row_crc32"][...] = row_sums
    values = summed_values(entry)
    entry["states/crc32"][...] = [
        state_crc32(sums, {name: column[k] for name, column in values.items()}) for k, sums in enumerate(row_sums)
    ]
