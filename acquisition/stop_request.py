"""Ctrl-C and the stop button: once means finish the state, twice means stop now."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self

#: Sent by a thread of this process to its main thread.
FAILED = signal.SIGUSR1


class StopRequest:
    """Counts requests to stop. The second one interrupts the measuring thread with KeyboardInterrupt.

    As a context manager in the main thread it takes SIGINT and SIGTERM; the live page calls `request`.

    Parameters
    ----------
    patience : which request interrupts at once; 1 where there is no state to finish.
    tell : told by the signal handler what a request that does not interrupt will do; must not use buffered output.
    """

    def __init__(self, patience: int = 2, tell: Callable[[str], object] | None = None) -> None:
        self._patience = patience
        self._tell = tell
        self._count = 0
        self._failing_here = False
        self._failure: Exception | None = None
        self._previous: dict[int, Any] = {}
        self._lock = threading.Lock()

    @property
    def requested(self) -> bool:
        """True after the first request."""
        return self._count > 0

    def request(self) -> None:
        """What Ctrl-C does, from any thread."""
        if self._previous:
            os.kill(os.getpid(), signal.SIGINT)
        else:
            self._add()

    def fail(self, failure: Exception) -> None:
        """End with this error what the main thread does within `failing_here`, from any thread."""
        self._failure = failure
        if self._failing_here and self._previous:
            os.kill(os.getpid(), FAILED)

    @contextmanager
    def failing_here(self) -> Iterator[None]:
        """Where `fail` interrupts; elsewhere clean-up is under way, which it must not cut short."""
        self._failing_here = True
        try:
            yield
        finally:
            self._failing_here = False

    def _raise_failure(self, number: int, frame: FrameType | None) -> None:
        if self._failing_here and self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure

    def _add(self) -> int:
        with self._lock:
            self._count += 1
            return self._count

    def _count_signal(self, number: int, frame: FrameType | None) -> None:
        count = self._add()
        # Each further one interrupts as well: what hangs after the second must not hold the program.
        if count >= self._patience:
            raise KeyboardInterrupt
        if self._tell is not None:
            self._tell("stopping after this state; once more stops at once")

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._count_signal)
            self._previous[FAILED] = signal.signal(FAILED, self._raise_failure)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()
