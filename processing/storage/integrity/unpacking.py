"""Rows of datasets, those of `packed` among them: unpacked here, on several threads.

HDF5 unpacks one chunk after the other with zlib. What cannot be unpacked here it is asked to read itself: its errors
are the only ones.
"""

import sys
from collections import OrderedDict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from threading import Lock
from typing import Any, cast

import h5py
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from processing.computing.threads import thread_count

#: Its stubs say that it were an instance.
DAMAGED = cast(type[Exception], isal_zlib.IsalError)


class KeptChunks:
    """The unpacked chunks of one dataset that were used in part: who reads it row by row wants the next row soon."""

    #: A band of rows of some fifty states.
    MOST_BYTES = 1 << 25

    def __init__(self) -> None:
        self._chunks: OrderedDict[tuple[int, ...], NDArray[Any]] = OrderedDict()
        self._bytes = 0
        self._lock = Lock()

    def get(self, start: tuple[int, ...]) -> NDArray[Any] | None:
        """The chunk that begins at this index; None where it is not kept."""
        with self._lock:
            if start in self._chunks:
                self._chunks.move_to_end(start)
            return self._chunks.get(start)

    def keep(self, start: tuple[int, ...], chunk: NDArray[Any]) -> None:
        """Keep a chunk, in place of those that were not asked for the longest."""
        with self._lock:
            if start not in self._chunks:
                self._bytes += chunk.nbytes
            self._chunks[start] = chunk
            while self._bytes > self.MOST_BYTES:
                self._bytes -= self._chunks.popitem(last=False)[1].nbytes


def read_rows(
    source: h5py.Dataset, rows: slice, first: tuple[int, ...] = (), cache: KeptChunks | None = None
) -> NDArray[Any]:
    """Rows of a dataset (first..., more..., rows, columns), as `source[*first, ..., rows, :]`.

    Parameters
    ----------
    cache : chunks of this dataset that earlier calls have unpacked; this one adds its own.

    Raises
    ------
    OSError
        The file is damaged.
    """
    start, stop, step = rows.indices(source.shape[-2])
    if step == 1 and stop > start and is_packed(source):
        try:
            return _unpack(source, start, stop, first, cache=cache)
        except (OSError, ValueError, RuntimeError, DAMAGED):
            # A chunk that was never written, is not packed, or is damaged.
            pass
    return np.asarray(source[(*first, ..., rows, slice(None))])


def is_packed(source: h5py.Dataset) -> bool:
    """Whether it is one of `packing.create_packed`, in this machine's order of bytes."""
    chunk = source.chunks
    if chunk is None or source.compression != "gzip" or not source.shuffle or source.fletcher32:
        return False
    native = source.dtype.isnative and sys.byteorder == "little" and source.dtype.kind in "uif"
    return bool(native and source.scaleoffset is None and set(chunk[:-2]) <= {1} and chunk[-1] == source.shape[-1])


def _unpack(
    source: h5py.Dataset, start: int, stop: int, first: tuple[int, ...], *, cache: KeptChunks | None
) -> NDArray[Any]:
    more, columns, height = source.shape[len(first) : -2], source.shape[-1], source.chunks[-2]
    rows = np.empty((*more, stop - start, columns), dtype=source.dtype)

    def fill(place: tuple[int, ...], top: int) -> None:
        part = slice(max(start, top), min(stop, top + height))
        index = (*first, *place, top, 0)
        block = None if cache is None else cache.get(index)
        if block is None:
            skipped, raw = source.id.read_direct_chunk(index)
            if skipped:
                raise ValueError("a chunk that not every filter was used for")
            block = _values(isal_zlib.decompress(raw), source.dtype).reshape(height, columns)
            if cache is not None and part.stop - part.start < height:
                cache.keep(index, block)
        rows[place][part.start - start : part.stop - start] = block[part.start - top : part.stop - top]

    chunks = list(_chunks(more, start // height * height, stop, height))
    threads = min(thread_count(), len(chunks))
    if threads == 1:
        for place, top in chunks:
            fill(place, top)
        return rows
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(fill, *chunk) for chunk in chunks]:
            done.result()
    return rows


def _chunks(more: tuple[int, ...], top: int, stop: int, height: int) -> Iterator[tuple[tuple[int, ...], int]]:
    return product(product(*map(range, more)), range(top, stop, height))


def _values(shuffled: bytes, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Values of which all first bytes, then all second bytes, ... stand together."""
    by_byte = np.frombuffer(shuffled, np.uint8).reshape(dtype.itemsize, -1)
    words = by_byte[0].astype(f"u{dtype.itemsize}")
    for k, byte in enumerate(by_byte[1:], 1):
        words |= np.left_shift(byte, 8 * k, dtype=words.dtype)
    return np.asarray(words.view(dtype))
