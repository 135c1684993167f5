"""A log that another process appends to its file: a disc that hangs or is full does not block the program."""

import contextlib
import os
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

#: Text kept in memory while the disc takes nothing; the oldest is dropped first.
KEPT_BYTES = 1 << 20
#: Longest wait for the disc when the log is closed.
CLOSE_S = 1.0

#: Processes that still wait for a disc; a handle that is dropped complains.
_waiting: list[subprocess.Popen[bytes]] = []


def start_appending(path: Path) -> subprocess.Popen[bytes]:
    """A process that appends to a file what is written to its standard input. Raises OSError."""
    return subprocess.Popen(
        # Without the packages of this environment it begins in 20 ms.
        [sys.executable, "-I", "-S", __file__, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


class LogProcess:
    """Appends text to a file; without one, or without a process to be had, it forgets it."""

    def __init__(self, path: Path | None) -> None:
        self._pending = b""
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe = -1
        if path is not None:
            with contextlib.suppress(OSError):
                self._process = start_appending(path)
                assert self._process.stdin is not None
                self._pipe = self._process.stdin.fileno()
                os.set_blocking(self._pipe, False)

    def add(self, text: str) -> None:
        """Add text."""
        with self._lock:
            self._pending = (self._pending + text.encode())[-KEPT_BYTES:]
        self.flush()

    def flush(self) -> None:
        """Pass on the pending text, as far as the pipe takes it now."""
        with self._lock, contextlib.suppress(OSError):
            if self._process is not None and self._pending:
                self._pending = self._pending[os.write(self._pipe, self._pending) :]

    def close(self) -> None:
        """Pass on the pending text and end, as far as the disc takes it within CLOSE_S."""
        process, end_s = self._process, time.monotonic() + CLOSE_S
        if process is None:
            return
        while self._pending and process.poll() is None and time.monotonic() < end_s:
            self.flush()
            time.sleep(0.005)
        with self._lock:
            self._process = None
            assert process.stdin is not None
            process.stdin.close()
        try:
            process.wait(max(0.0, end_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            _waiting.append(process)


def _write(path: str) -> None:
    """Append the standard input to a file that has no other name: a link may lead to a file of another user."""
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    with open(os.open(path, flags, 0o666), "ab") as file:
        status = os.fstat(file.fileno())
        if stat.S_ISREG(status.st_mode) and status.st_nlink == 1:
            while text := os.read(0, 1 << 16):
                # A full disc may have room for a later line.
                with contextlib.suppress(OSError):
                    file.write(text)
                    file.flush()


if __name__ == "__main__":
    _write(sys.argv[1])
