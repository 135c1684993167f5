"""What lossless compression saves and costs: size, seconds of processor time to write and to read, for each file.

    python benchmarks/packed_files.py CAPTURE_OR_PRODUCT.h5 ...

Every plane (of a capture, the frames) is copied plain, as products are written, and by the compressors that other
programs would have to know. A warm file: from a disc, what is half as large comes twice as fast.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from processing.storage.packed import BYTE_WORTH, SMALL_BYTE_WORTH, Packing, create_packed, pack
from processing.storage.product import is_product
from processing.storage.unpacked import read_rows

ROUNDS = 3


def planes(h5: h5py.File) -> list[h5py.Dataset]:
    """What takes the room in a file."""
    if is_product(Path(h5.filename)):
        return [node for node in h5["entry/data"].values() if node.ndim > 1]
    return [h5["entry/instrument/detector/data"]]


def ways() -> dict[str, Callable[[h5py.File, h5py.Dataset], None]]:
    """How a plane is written, by name."""

    def plain(out: h5py.File, plane: h5py.Dataset) -> None:
        out.create_dataset("plane", data=plane[...])

    def where_worth(byte_worth: float | None = None) -> Callable[[h5py.File, h5py.Dataset], None]:
        def write(out: h5py.File, plane: h5py.Dataset) -> None:
            usual = BYTE_WORTH if is_product(Path(plane.file.filename)) else SMALL_BYTE_WORTH
            packing = Packing.of(plane, byte_worth or usual)
            if packing.is_worth_it:
                pack(plane, create_packed(out, "plane", plane.shape, plane.dtype), packing)
            else:
                plain(out, plane)

        return write

    def all_packed(out: h5py.File, plane: h5py.Dataset) -> None:
        every_byte = Packing(ratio=1.0, deflated=(True,) * plane.dtype.itemsize)
        pack(plane, create_packed(out, "plane", plane.shape, plane.dtype), every_byte)

    def hdf5(compression: str) -> Callable[[h5py.File, h5py.Dataset], None]:
        def write(out: h5py.File, plane: h5py.Dataset) -> None:
            create_packed(out, "like", plane.shape, plane.dtype)
            chunks = out["like"].chunks
            level = 1 if compression == "gzip" else None
            out.create_dataset(
                "plane", data=plane[...], chunks=chunks, compression=compression, compression_opts=level, shuffle=True
            )

        return write

    found = {"plain": plain, "ours": where_worth()}
    found |= {f"bytes that become 1/{worth:g}": where_worth(worth) for worth in (1.2, 1.5, 2.0, 2.5)}
    found |= {"every byte of every plane": all_packed, "HDF5's deflate": hdf5("gzip")}
    return found | {"LZF (h5py alone)": hdf5("lzf")}


def measure(write: Callable[[h5py.File, h5py.Dataset], None], plane: h5py.Dataset, path: Path) -> np.ndarray:
    """Bytes, seconds to write, to read as HDF5 does and as `process` does; the shortest of some rounds."""
    rounds = []
    for _ in range(ROUNDS):
        start_s = time.process_time()
        with h5py.File(path, "w") as out:
            write(out, plane)
        wrote_s = time.process_time() - start_s
        with h5py.File(path) as out:
            start_s = time.process_time()
            theirs = out["plane"][...]
            between_s = time.process_time()
            ours = read_rows(out["plane"], slice(None))
            read_s = between_s - start_s, time.process_time() - between_s
            for values in (theirs, ours):
                assert np.array_equal(values, plane[...], equal_nan=plane.dtype.kind == "f"), "not lossless"
            rounds.append((out["plane"].id.get_storage_size(), wrote_s, *read_s))
    return np.min(rounds, axis=0)


def main() -> None:
    """Print a line for each file and way."""
    for path in map(Path, sys.argv[1:]):
        with h5py.File(path) as h5, tempfile.TemporaryDirectory() as folder:
            there = planes(h5)
            size = sum(plane.nbytes for plane in there)
            print(f"{path.name}: {size / 1e6:.0f} MB")
            for name, write in ways().items():
                stored, *took_s = sum(measure(write, plane, Path(folder) / "copy.h5") for plane in there)
                wrote, theirs, ours = (f"{s:5.2f} s" for s in took_s)
                print(f"  {name:26s} {stored / 1e6:6.1f} MB  write {wrote}  read by HDF5 {theirs}, by process {ours}")


if __name__ == "__main__":
    main()
