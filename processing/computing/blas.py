"""BLAS on one thread.

Our problems are many and small, or spread over our own threads: those of BLAS would wait for one another, on a busy
machine ten times as long as the work takes, and the last bits of a result would depend on how many there are.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock
from typing import Any

from threadpoolctl import threadpool_info, threadpool_limits

#: What a BLAS looks at when it is loaded.
THREADS_VARIABLE = "OPENBLAS_NUM_THREADS"

_gate = Lock()
_within: "list[_OneThread]" = []


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold BLAS to one thread, as `with` or as a decorator.

    The limit is the process's: the first thread that comes in sets it, and the last one that leaves takes it away.
    """
    with _gate:
        _within.append(_within[0] if _within else _OneThread.begin())
    try:
        yield
    finally:
        with _gate:
            limit = _within.pop()
            if not _within:
                limit.end()


@dataclass(frozen=True)
class _OneThread:
    """The limit on every BLAS that is loaded, or comes: SciPy brings its own, a fifth of a second where none is needed.

    Attributes
    ----------
    limits : of those that are there.
    threads : that one which comes should have afterwards; None if SciPy's is there.
    variable : what the environment says.
    """

    limits: Any
    threads: int | None
    variable: str | None

    @classmethod
    def begin(cls) -> "_OneThread":
        threads = None
        if not _has_scipy():
            threads = max((pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"), default=1)
        begun = cls(threadpool_limits(limits=1, user_api="blas"), threads, os.environ.get(THREADS_VARIABLE))
        os.environ[THREADS_VARIABLE] = "1"
        return begun

    def end(self) -> None:
        os.environ.pop(THREADS_VARIABLE)
        if self.variable is not None:
            os.environ[THREADS_VARIABLE] = self.variable
        if self.threads is not None and _has_scipy():
            threadpool_limits(limits=self.threads, user_api="blas")
        self.limits.restore_original_limits()


def _has_scipy() -> bool:
    return "scipy.linalg" in sys.modules
