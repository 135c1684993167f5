"""Lossless compression that every HDF5 reader knows: bytes shuffled, then deflated, in chunks of whole rows.

bitshuffle with LZ4 is faster still, but files made with it open only where its plug-in is installed. HDF5's own
deflate is several times slower than ISA-L's, which writes the same format; chunks are made here, on several threads,
and put into the file as they are.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import h5py
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from processing.computing.threads import thread_count

#: Pixels of a chunk: as many as readers take at once (`Product.row_blocks`).
CHUNK_PIXELS = 1 << 17
#: Of deflate; higher ones gain 1 % here and cost a third of the speed.
LEVEL = 1
#: What a plane must shrink by to be worth unpacking at each reading: the mantissas of plain noise do not.
WORTH = 1.3
#: Chunks looked at to tell.
SAMPLES = 6


def shrinks_to(source: h5py.Dataset) -> int:
    """Bytes that a dataset will have, from some of its chunks; all of them where packing is not worth it."""
    size = int(source.size) * source.dtype.itemsize
    chunk = chunk_shape(source.shape)
    starts = list(_chunk_starts(source.shape, chunk))
    blocks = [source[tuple(map(_span, start, chunk))] for start in starts[:: -(-len(starts) // SAMPLES)]]
    ratio = sum(block.nbytes for block in blocks) / max(sum(len(_deflated(b, b.shape)) for b in blocks), 1)
    return int(size / ratio) if ratio >= WORTH else size


def chunk_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Of a dataset (leading..., rows, columns): whole rows of one plane, an even number, for mosaics."""
    rows, columns = shape[-2:]
    return (*(1 for _ in shape[:-2]), min(rows, max(2, CHUNK_PIXELS // max(columns, 1) // 2 * 2)), columns)


def create_packed(parent: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any) -> h5py.Dataset:
    """An empty compressed dataset (leading..., rows, columns) in chunks of `chunk_shape`."""
    chunk = chunk_shape(shape)
    return parent.create_dataset(
        name, shape, dtype, chunks=chunk, compression="gzip", compression_opts=LEVEL, shuffle=True
    )


def pack(source: h5py.Dataset, target: h5py.Dataset) -> None:
    """Copy every value of a dataset into one made by `create_packed`, some chunks at a time.

    Raises
    ------
    OSError
        The disc is full, or the source cannot be read.
    """
    threads = thread_count()
    starts = _chunk_starts(target.shape, target.chunks)
    with ThreadPoolExecutor(threads) as pool:
        while batch := list(itertools.islice(starts, 4 * threads)):
            blocks = [source[tuple(map(_span, start, target.chunks))] for start in batch]
            for start, raw in zip(batch, pool.map(lambda block: _deflated(block, target.chunks), blocks), strict=True):
                target.id.write_direct_chunk(start, raw)


def _chunk_starts(shape: tuple[int, ...], chunk: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    return itertools.product(*(range(0, size, step) for size, step in zip(shape, chunk, strict=True)))


def _span(start: int, size: int) -> slice:
    return slice(start, start + size)


def _deflated(block: NDArray[Any], chunk: tuple[int, ...]) -> bytes:
    """A chunk as HDF5 keeps it: first bytes of all values, then all second bytes, ..., deflated."""
    if block.shape != chunk:
        # The last chunk of a plane is as large as the others in the file.
        block = np.pad(block, [(0, whole - size) for whole, size in zip(chunk, block.shape, strict=True)])
    by_value = np.ascontiguousarray(block).reshape(-1).view(np.uint8).reshape(-1, block.itemsize)
    packed: bytes = isal_zlib.compress(np.ascontiguousarray(by_value.T).data, LEVEL)
    return packed
