"""BLAS on one thread.

Our problems are many and small, or spread over our own threads: those of BLAS would wait for one another, on a busy
machine ten times as long as the work takes, and the last bits of a result would depend on how many there are.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

from threadpoolctl import threadpool_limits

_gate = Lock()
_within: list[Any] = []


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold BLAS to one thread, as `with` or as a decorator.

    The limit is the process's: the first thread that comes in sets it, and the last one that leaves takes it away.
    """
    import scipy.linalg  # noqa: F401 - SciPy brings a BLAS of its own, which can be told once it is there

    with _gate:
        _within.append(_within[0] if _within else threadpool_limits(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _gate:
            limits = _within.pop()
            if not _within:
                limits.restore_original_limits()
