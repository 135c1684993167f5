"""Lossless compression that every HDF5 reader knows: bytes shuffled, then deflated, in chunks of whole rows.

bitshuffle with LZ4 is faster still, but files made with it open only where its plug-in is installed. HDF5's own
deflate is several times slower than ISA-L's, which writes the same format; chunks are made here, on several threads,
and put into the file as they are. Of each value only those bytes are deflated that shrink: the last ones of a mantissa
are noise, and go into the same stream as they are.
"""

import itertools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from struct import pack as in_bytes
from typing import Any

import h5py
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from processing.computing.threads import thread_count

#: Pixels of a chunk. Who wants one pixel of every plane unpacks a chunk of each: with four times as many it takes four
#: times as long, and reading everything is a tenth faster only.
CHUNK_PIXELS = 1 << 15
#: Of deflate; higher ones gain 1 % here and cost a third of the speed.
LEVEL = 1
#: What a plane must shrink by to be worth unpacking at each reading.
WORTH = 1.3
#: What the first (second, ...) bytes of all values must shrink by to be deflated. Of products, which are read again and
#: again, those between a sixth and a half are an eighth of the size and nearly half of the time of reading.
BYTE_WORTH = 2.0
#: The same of captures that are packed because they shall be small.
SMALL_BYTE_WORTH = 1.2
#: Strips that are looked at to tell, and pixels of each.
SAMPLES, SAMPLE_PIXELS = 6, 1 << 14

#: Of the stream (RFC 1950 and 1951): its head, for a window of 32 KiB; an empty last block; most bytes of a block that
#: holds them as they are.
HEAD, END, MOST_STORED = b"\x78\x01", b"\x01\x00\x00\xff\xff", 0xFFFF


@dataclass(frozen=True)
class Packing:
    """Packing of a dataset, chosen from samples of it.

    Attributes
    ----------
    ratio : how many times smaller it becomes.
    deflated : for each byte of a value, whether it is deflated or stored as it is.
    """

    ratio: float
    deflated: tuple[bool, ...]

    @classmethod
    def of(cls, source: h5py.Dataset, byte_worth: float = BYTE_WORTH) -> "Packing":
        """Deflate some strips of a dataset or an array (leading..., rows, columns), byte by byte."""
        itemsize = source.dtype.itemsize
        blocks = [source[(*place, rows)] for place, rows in _samples(source.shape)]
        size, packed = sum(block.size for block in blocks), np.zeros(itemsize)
        for block in blocks:
            packed += [len(isal_zlib.compress(plane.data, LEVEL)) for plane in _byte_planes(block)]
        deflated = size / np.maximum(packed, 1) >= byte_worth
        return cls(itemsize * size / max(float(np.where(deflated, packed, size).sum()), 1.0), tuple(deflated.tolist()))

    @property
    def is_worth_it(self) -> bool:
        """Whether the dataset should be packed at all."""
        return self.ratio >= WORTH


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


def pack(source: h5py.Dataset, target: h5py.Dataset, packing: Packing | None = None) -> None:
    """Copy every value of a dataset into one made by `create_packed`, an image at a time.

    Raises OSError: the disc is full, or the source cannot be read.
    """
    deflated = (packing or Packing.of(source)).deflated
    height, threads = target.chunks[-2], thread_count()
    # One reading of an image and one task for each thread cost less than those for each chunk.
    parts = [part.tolist() for part in np.array_split(np.arange(0, target.shape[-2], height), threads) if part.size]
    with ThreadPoolExecutor(threads) as pool:
        for place in np.ndindex(target.shape[:-2]):
            image = source[place]

            def packed(tops: list[int], image: NDArray[Any] = image) -> list[bytes]:
                return [_stream(image[top : top + height], height, deflated) for top in tops]

            for tops, streams in zip(parts, pool.map(packed, parts), strict=True):
                for top, raw in zip(tops, streams, strict=True):
                    target.id.write_direct_chunk((*place, top, 0), raw)


def _samples(shape: tuple[int, ...]) -> Iterator[tuple[tuple[int, ...], slice]]:
    """Strips of rows, from the middles of chunks that are spread over a dataset: index of the image, and rows."""
    *leading, rows, columns = shape
    chunk = chunk_shape(shape)[-2]
    starts = list(itertools.product(np.ndindex(*leading), range(0, rows, chunk)))
    for place, start in starts[:: -(-len(starts) // SAMPLES)]:
        height = min(chunk, rows - start)
        strip = min(max(SAMPLE_PIXELS // max(columns, 1), 1), height)
        top = start + (height - strip) // 2
        yield place, slice(top, top + strip)


def _byte_planes(block: NDArray[Any]) -> NDArray[np.uint8]:
    """The first bytes of all values, then all second bytes, ...: (bytes of a value, values)."""
    words = np.ascontiguousarray(block).reshape(-1).view(f"<u{block.itemsize}")
    planes, shifted = np.empty((block.itemsize, block.size), np.uint8), np.empty_like(words)
    # Shifts and casts of whole numbers run in vector registers, copies of every n-th byte do not.
    for k, plane in enumerate(planes):
        np.copyto(plane, np.right_shift(words, 8 * k, out=shifted) if k else words, casting="unsafe")
    return planes


def _stream(block: NDArray[Any], height: int, deflated: tuple[bool, ...]) -> bytes:
    """A chunk (height, columns) as HDF5 keeps it, of a block that may have fewer rows: one zlib stream."""
    if len(block) < height:
        # The last chunk of a plane is as large as the others in the file.
        block = np.pad(block, [(0, height - len(block)), (0, 0)])
    planes = _byte_planes(block)
    parts: list[bytes | memoryview] = [HEAD]
    deflater = isal_zlib.compressobj(LEVEL, isal_zlib.DEFLATED, -isal_zlib.MAX_WBITS)
    for plane, shrinks in zip(planes, deflated, strict=True):
        if shrinks:
            # A full flush ends at a whole byte, and nothing after it refers to what was before.
            parts += [deflater.compress(plane.data), deflater.flush(isal_zlib.Z_FULL_FLUSH)]
        else:
            parts += _stored(memoryview(plane))
    return b"".join([*parts, END, in_bytes(">I", isal_zlib.adler32(planes.reshape(-1).data))])


def _stored(raw: memoryview) -> Iterator[bytes | memoryview]:
    for start in range(0, len(raw), MOST_STORED):
        piece = raw[start : start + MOST_STORED]
        yield in_bytes("<BHH", 0, len(piece), len(piece) ^ 0xFFFF)
        yield piece
