"""Can a compressed file be read as fast as a plain one? What a copy gives, beside the fastest codecs.

    python benchmarks/unpack_rates.py CAPTURE.h5 [THREADS]

The frames of a capture, each compressed by itself, in memory: MB of counts a second by the clock, best of the repeats.
Plain counts are copied, the least that any reader does with them; Blosc2 with LZ4 is the fastest codec that is in use
for such data (`pip install blosc2`). Last, what a file that is read from a disc gains: up to which rate of the disc
each way is faster.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import blosc2
import h5py
import numpy as np
from isal import isal_zlib

from processing.storage.unpacked import _values

REPEATS = 9


def fastest_s(work: Callable[[], object]) -> float:
    """Seconds of the fastest of some repeats."""
    times = []
    for _ in range(REPEATS):
        start_s = time.perf_counter()
        work()
        times.append(time.perf_counter() - start_s)
    return min(times)


def main() -> None:
    """A line for each way of unpacking, with one thread and with several."""
    threads = int(sys.argv[2]) if len(sys.argv) > 2 else 2
    with h5py.File(sys.argv[1]) as h5:
        frames = h5["entry/instrument/detector/data"][...].reshape(-1, *h5["entry/instrument/detector/data"].shape[-2:])
    out = np.empty_like(frames)
    packed: dict[str, tuple[list[bytes], Callable[[bytes, np.ndarray], object]]] = {
        "copy": (list(frames), lambda frame, into: np.copyto(into, frame))
    }

    def by_blosc(raw: bytes, into: np.ndarray) -> None:
        blosc2.decompress2(raw, dst=into)

    for name, codec, shuffle in (
        ("Blosc2: shuffle, LZ4", blosc2.Codec.LZ4, blosc2.Filter.SHUFFLE),
        ("Blosc2: bitshuffle, LZ4", blosc2.Codec.LZ4, blosc2.Filter.BITSHUFFLE),
        ("Blosc2: bitshuffle, Zstandard", blosc2.Codec.ZSTD, blosc2.Filter.BITSHUFFLE),
    ):
        how = {"codec": codec, "filters": [shuffle], "clevel": 1, "nthreads": 1}
        packed[name] = [blosc2.compress2(frame, **how) for frame in frames], by_blosc

    def by_isal(raw: bytes, into: np.ndarray) -> None:
        into[...] = _values(isal_zlib.decompress(raw), frames.dtype).reshape(into.shape)

    by_byte = [np.ascontiguousarray(frame.reshape(-1).view(np.uint8).reshape(-1, 2).T).data for frame in frames]
    packed["ours: shuffle, deflate by ISA-L"] = [isal_zlib.compress(frame, 1) for frame in by_byte], by_isal

    size = frames.nbytes / 1e6
    print(f"{len(frames)} frames, {size:.1f} MB of counts; MB/s with 1 thread and with {threads}")
    plain_s = None
    for name, (chunks, unpack) in packed.items():
        stored = sum(np.asarray(chunk).nbytes if name == "copy" else len(chunk) for chunk in chunks) / 1e6
        times = []
        for count in (1, threads):
            with ThreadPoolExecutor(count) as pool:
                times.append(
                    fastest_s(lambda chunks=chunks, unpack=unpack, pool=pool: list(pool.map(unpack, chunks, out)))
                )
            assert np.array_equal(out, frames), "not lossless"
        plain_s = plain_s or times
        even = [(size - stored) / (took - plain) for took, plain in zip(times, plain_s, strict=True) if took > plain]
        slower = "  ".join(f"{took / plain:4.1f}" for took, plain in zip(times, plain_s, strict=True))
        gain = "" if name == "copy" else "  faster from a disc below " + ", ".join(f"{rate:.0f}" for rate in even)
        print(
            f"{name:34s} {stored:5.1f} MB  {size / times[0]:6.0f} {size / times[1]:6.0f}  times a copy {slower}{gain}"
        )


if __name__ == "__main__":
    main()
