"""The journal of the guard: written by a process of its own, so that a disc that hangs holds up nothing."""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import subprocess
import threading
from pathlib import Path
from typing import Any

#: What is kept in memory while the disc takes nothing.
JOURNAL_BYTES = 1 << 20


class Journal:
    """A log in JSON lines, appended to its file, if it has one, by a process of its own."""

    def __init__(self, path: Path | None) -> None:
        self._waiting = b""
        self._lock = threading.Lock()
        self._appending: subprocess.Popen[bytes] | None = None
        if path is not None:
            with contextlib.suppress(OSError):
                self._appending = subprocess.Popen(
                    ["tee", "-a", str(path)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,
                )
                os.set_blocking(self._pipe(), False)

    def note(self, event: str, **details: Any) -> None:
        """Add a line; a log that cannot be written holds up nothing."""
        when = datetime.datetime.now().astimezone().isoformat(timespec="milliseconds")
        with self._lock:
            self._waiting = (self._waiting + json.dumps({"time": when, "event": event} | details).encode() + b"\n")[
                -JOURNAL_BYTES:
            ]
        self.flush()

    def flush(self) -> None:
        """Pass on what waits, as far as it is taken now."""
        with self._lock, contextlib.suppress(OSError):
            if self._appending is not None and self._waiting:
                self._waiting = self._waiting[os.write(self._pipe(), self._waiting) :]

    def _pipe(self) -> int:
        assert self._appending is not None
        assert self._appending.stdin is not None
        return self._appending.stdin.fileno()
