"""Feed planar images of any real type to compiled loops that know float64 chunks only.

Each further type or layout of a big loop would cost seconds of compilation.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.computing.threads import for_ranges

#: Pixels that a compiled loop gets at a time: small enough for the second-level cache.
CHUNK = 2048


def for_chunks(kernel: Callable[..., object], source: NDArray[Any], *outputs: NDArray[Any]) -> None:
    """Call `kernel(chunk, count, *results)` for chunks of a planar image and store what it writes, on all cores.

    Parameters
    ----------
    kernel : compiled function; reads chunk (rows, CHUNK), of which `count` pixels are valid, and fills the results.
        Chunk and results are float64 and C-ordered, whatever the arrays are.
    source : (rows, pixels).
    outputs : (..., pixels) each; the kernel gets one (..., CHUNK) for each.
    """
    flat = [out.reshape(-1, out.shape[-1]) for out in outputs]
    if not all(np.shares_memory(f, out) for f, out in zip(flat, outputs, strict=True) if out.size):
        raise ValueError("the leading axes of an output must be contiguous")

    if source.shape[1] <= CHUNK and all(a.dtype == float and a.flags.c_contiguous for a in (source, *outputs)):
        kernel(source, source.shape[1], *outputs)
        return

    def loop(start: int, stop: int) -> None:
        chunk = np.empty((source.shape[0], CHUNK))
        results = [np.empty((*out.shape[:-1], CHUNK)) for out in outputs]
        rows = [result.reshape(-1, CHUNK) for result in results]
        for first in range(start, stop, CHUNK):
            count = min(CHUNK, stop - first)
            chunk[:, :count] = source[:, first : first + count]
            kernel(chunk, count, *results)
            for out, result in zip(flat, rows, strict=True):
                out[:, first : first + count] = result[:, :count]

    for_ranges(source.shape[1], loop)
