"""Ctrl-C and the stop button: once means finish the state, twice means stop now."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType, TracebackType
from typing import Any, Self


class StopRequest:
    """Counts requests to stop. The second one interrupts the measuring thread with KeyboardInterrupt.

    As a context manager in the main thread it takes SIGINT and SIGTERM; the live page calls `request`.

    Parameters
    ----------
    patience : which request interrupts at once; 1 where there is no state to finish.
    """

    def __init__(self, patience: int = 2) -> None:
        self._patience = patience
        self._count = 0
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

    def _add(self) -> int:
        with self._lock:
            self._count += 1
            return self._count

    def _heard(self, number: int, frame: FrameType | None) -> None:
        if self._add() == self._patience:
            raise KeyboardInterrupt

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._heard)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()
