"""The live page of a run, served by another process: the part in the measuring program.

The measuring thread hands over what it has and never waits: a few kilobytes of state into a socket that drops what does
not fit, and the last frame into memory that both processes see, if the page is done with the frame before. Everything
else, and every browser, is the concern of the other process (`live_process`), which runs when nothing else wants to.
"""

import contextlib
import json
import mmap
import os
import secrets
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from acquisition.screen.observer import Mosaic, Observer, StateReport
from acquisition.stop_request import StopRequest
from processing.instrument.states import StateTable

#: Longest message to the page, characters.
LONGEST = 300
#: How long a page may take to end after the run.
ENDING_S = 5.0


class LiveView(Observer):
    """Shows a run on a page at a local address; a context manager.

    Attributes
    ----------
    url : address of the page, with the token that everything on it needs.
    """

    def __init__(self, simulated: bool, black: float, full_scale: int, stop: StopRequest, *, port: int = 0) -> None:
        self._stop = stop
        self._view: dict[str, Any] = {"title": "", "activity": "starting", "done": 0, "pending": 0, "status": "running"}
        self._messages: deque[str] = deque(maxlen=50)
        self._monitor: deque[float] = deque(maxlen=200)
        self._start_s = time.monotonic()
        # One at a time: the stop button and the measuring thread both have something to say.
        self._lock = threading.Lock()
        self._memory = os.memfd_create("umov live frame")
        self._mapped: mmap.mmap | None = None
        self._page_is_done = True
        self._listener = socket.create_server(("127.0.0.1", port), backlog=1024)
        token = secrets.token_urlsafe(16)
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}/?token={token}"
        self._settings = {"token": token, "black": black, "full_scale": full_scale, "simulated": simulated}

    def __enter__(self) -> Self:
        self._link, child_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        descriptors = [self._listener.fileno(), child_end.fileno(), self._memory]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "acquisition.screen.live_process", *map(str, descriptors)],
            pass_fds=descriptors,
            cwd=Path(__file__).parents[2],
            stdin=subprocess.DEVNULL,
            # Ctrl-C in the terminal is for the measuring program.
            start_new_session=True,
        )
        child_end.close()
        self._listener.close()
        self._send(self._settings)
        self._hearing = threading.Thread(target=self._hear, name="live view", daemon=True)
        self._hearing.start()
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            # The page shows the end for as long as it takes to read this, then its process ends.
            self._link.shutdown(socket.SHUT_WR)
        try:
            self.process.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._hearing.join(ENDING_S)
        self._link.close()
        os.close(self._memory)

    # --- what the run tells ------------------------------------------------------------------------------

    def campaign_progress(self, number: int, total: int, name: str) -> None:
        self._show(campaign_done=number, campaign_total=total, campaign_capture=name)

    def run_started(self, title: str, table: StateTable, pending: int, mosaic: Mosaic | None) -> None:
        self._monitor.clear()
        self._start_s = time.monotonic()
        self._show(title=title, done=0, pending=pending, status="running", mosaic=mosaic)

    def activity(self, text: str) -> None:
        self._show(activity=text[:LONGEST])

    def state_done(self, report: StateReport) -> None:
        done, pending = self._view["done"] + 1, self._view["pending"]
        elapsed_s = time.monotonic() - self._start_s
        if report.role != "dark":
            self._monitor.append(report.monitor)
        self._show(
            self._hand_over(report.pixels),
            done=done,
            activity=f"state {report.state} ({report.role})",
            left_s=round(elapsed_s / done * (pending - done), 1),
            frame=report.state,
            role=report.role,
            axes={name: str(position) for name, position in report.positions.items()},
            exposure_s=report.exposure_s,
            saturated=report.saturated_fraction,
            near_black=report.near_black_fraction,
        )

    def warning(self, text: str) -> None:
        self._messages.appendleft(f"{time.strftime('%H:%M:%S')} {text[:LONGEST]}")
        self._show()

    def run_ended(self, status: str, details: dict[str, Any]) -> None:
        self._show(status=status, activity=status)

    # --- between the processes ---------------------------------------------------------------------------

    def _show(self, shape: Sequence[int] | None = None, **changes: Any) -> None:
        """Send the whole view: one that is dropped is made good by the next. `shape` says that a frame lies ready."""
        self._view |= changes
        messages, monitor = list(self._messages), list(self._monitor)
        self._send({"view": self._view | {"messages": messages, "monitor": monitor}, "shape": shape})

    def _send(self, message: dict[str, Any]) -> None:
        with self._lock, contextlib.suppress(OSError):
            # Full, or its process has ended: the measurement goes on without its page.
            self._link.send(json.dumps(message).encode(), socket.MSG_DONTWAIT)

    def _hand_over(self, pixels: np.ndarray[Any, np.dtype[np.uint16]]) -> tuple[int, ...] | None:
        """Copy a frame to where the page sees it; its shape, or None while the page still has the one before."""
        if not self._page_is_done or pixels.ndim != 2:
            return None
        if self._mapped is None or self._mapped.size() < pixels.nbytes:
            os.ftruncate(self._memory, pixels.nbytes)
            self._mapped = mmap.mmap(self._memory, pixels.nbytes)
        self._page_is_done = False
        np.frombuffer(self._mapped, dtype=np.uint16, count=pixels.size).reshape(pixels.shape)[...] = pixels
        return (pixels.shape[0], pixels.shape[1])

    def _hear(self) -> None:
        with contextlib.suppress(OSError):
            while word := self._link.recv(64):
                if word == b"taken":
                    self._page_is_done = True
                elif word == b"stop":
                    self.warning("stop asked for on the live page")
                    self._stop.request()
