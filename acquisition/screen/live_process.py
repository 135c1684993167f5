"""The process that serves the live page: ``python -m acquisition.screen.live_process LISTENER LINK MEMORY``.

It takes no time from the measurement: it runs only when nothing else wants to, answers a few browsers at a time, and
draws a picture once however many ask for it. Nothing is given without the token.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import secrets
import socket
import sys
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any, ClassVar, TypeVar
from urllib.parse import parse_qs, urlsplit

import numpy as np
from numpy.typing import NDArray

from acquisition.screen.live_images import Modulation, dolp_png, histogram, last_frame_png
from processing.reports.design import style

Frame = NDArray[np.uint16]
Drawn = TypeVar("Drawn")

#: Browsers answered at the same time; others are told to come again.
CLIENTS = 8
#: A browser that is silent, or does not read, for so long is given up.
PATIENCE_S = 3.0
#: Largest message from the measuring program.
LARGEST = 1 << 18


class Shown:
    """What the page shows, and the pictures of the last frame, each drawn at most once."""

    def __init__(self, black: float, full_scale: int, simulated: bool) -> None:
        self._black, self._full_scale, self._simulated = black, full_scale, simulated
        self._lock = threading.Lock()
        self._view: dict[str, Any] = {}
        self._frame: Frame | None = None
        # Of every state with light, for the quick look of a rotation.
        self._modulation = Modulation()
        self._drawn: dict[str, Any] = {}

    def update(self, view: dict[str, Any], frame: Frame | None) -> None:
        """Take a view, and the frame that came with it if there is one."""
        with self._lock:
            if view["title"] != self._view.get("title") or view["done"] < self._view.get("done", 0):
                self._modulation = Modulation()
            self._view = view
            if frame is not None:
                self._frame, self._drawn = frame, {}
                if view["role"] != "dark":
                    self._modulation.add(frame)

    def snapshot(self) -> dict[str, Any]:
        """What the page asks for twice a second, ready for JSON."""
        with self._lock:
            view = dict(self._view)
            frame = self._frame
        quick = "modulation" if view.pop("mosaic", None) is None else "DoLP"
        view |= {"simulated": self._simulated, "quick": quick, "full_scale": self._full_scale}
        if frame is not None:
            view["histogram"] = self._once("histogram", lambda: histogram(frame, self._full_scale))
        return view

    def picture(self, name: str) -> bytes | None:
        """The last frame or the quick look as PNG; None while there is not enough for it."""
        with self._lock:
            frame, view, modulation = self._frame, dict(self._view), self._modulation.drawing(self._black)
        if frame is None:
            return None
        if name == "frame.png":
            return self._once(name, lambda: last_frame_png(frame, self._black, self._full_scale))
        mosaic = view.get("mosaic")
        if mosaic is None:
            return self._once(name, modulation)
        if view["role"] == "dark":
            return None
        return self._once(name, lambda: dolp_png(frame, mosaic, self._black))

    def _once(self, name: str, draw: Callable[[], Drawn]) -> Drawn:
        # Under the lock of its own pictures: a second browser waits for the first one's instead of drawing again.
        drawn = self._drawn
        with self._drawing:
            if name not in drawn:
                drawn[name] = draw()
            found: Drawn = drawn[name]
            return found

    _drawing: ClassVar[threading.Lock] = threading.Lock()


class Server(ThreadingHTTPServer):
    """Answers at most `CLIENTS` browsers at a time."""

    daemon_threads = True

    def __init__(self, listener: socket.socket, handler: type[BaseHTTPRequestHandler]) -> None:
        super().__init__(listener.getsockname(), handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listener
        self._free = threading.BoundedSemaphore(CLIENTS)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve it in a thread, or refuse it at once."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
            return
        with contextlib.suppress(OSError):
            request.settimeout(0)
            request.send(b"HTTP/1.0 503 Busy\r\nContent-Length: 0\r\nRetry-After: 1\r\n\r\n")
        self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """One browser; its place is free afterwards."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away in mid-sentence is no news."""


class Handler(BaseHTTPRequestHandler):
    """Page, state, pictures and the stop button."""

    shown: ClassVar[Shown]
    link: ClassVar[socket.socket]
    token: ClassVar[str]
    timeout = PATIENCE_S

    def do_GET(self) -> None:
        """Page, state and pictures."""
        path = self._allowed()
        if path is None:
            return
        if path == "/":
            page = files("acquisition.screen").joinpath("live_view.html").read_text(encoding="utf-8")
            self._send(200, "text/html; charset=utf-8", page.replace("/* design */", style()).encode())
        elif path == "/state":
            self._send(200, "application/json", json.dumps(self.shown.snapshot()).encode())
        elif path in ("/frame.png", "/quick.png"):
            image = self.shown.picture(path[1:])
            self._send(200 if image else 404, "image/png", image or b"")
        else:
            self._send(404, "text/plain", b"there is no such page")

    def do_POST(self) -> None:
        """The stop button."""
        path = self._allowed()
        if path == "/stop":
            self.link.send(b"stop")
            self._send(200, "text/plain", b"stopping")
        elif path is not None:
            self._send(404, "text/plain", b"there is no such action")

    def _allowed(self) -> str | None:
        """The path asked for; None, and an answer, for anyone without the token or from another machine's page."""
        url = urlsplit(self.path)
        # Another site that resolves its name to this machine sends its own name as host.
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        given = parse_qs(url.query).get("token", [""])[0]
        if host not in ("127.0.0.1", "localhost"):
            self._send(403, "text/plain", b"only for a browser on this machine")
        elif not secrets.compare_digest(given.encode(), self.token.encode()):
            self._send(403, "text/plain", b"the token is missing or wrong")
        else:
            return url.path
        return None

    def _send(self, code: int, kind: str, body: bytes) -> None:
        try:
            self.send_response(code)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.send_header(
                "Content-Security-Policy",
                "default-src 'none'; img-src 'self'; style-src 'unsafe-inline'; "
                "script-src 'unsafe-inline'; connect-src 'self'",
            )
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            self.wfile.write(body)
        except (BrokenPipeError, ConnectionResetError, TimeoutError):
            self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are no news."""


def take_updates(link: socket.socket, memory: int, shown: Shown) -> None:
    """Take what the measuring program sends until it has ended."""
    while data := link.recv(LARGEST):
        message = json.loads(data)
        frame = None
        if message["shape"] is not None:
            frame = _frame(memory, message["shape"])
        shown.update(message["view"], frame)
        if frame is not None:
            link.send(b"taken")


def _frame(memory: int, shape: list[int]) -> Frame:
    """A copy of the frame that lies in the memory shared with the measuring program."""
    count = int(np.prod(shape))
    with mmap.mmap(memory, 2 * count, prot=mmap.PROT_READ) as mapped:
        return np.frombuffer(mapped, dtype=np.uint16, count=count).reshape(shape).copy()


def run_only_when_idle() -> None:
    """Leave the processor to whoever wants it; where the system has no such class, be as nice as can be."""
    os.nice(19)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def main() -> None:
    """Serve until the measuring program has ended."""
    run_only_when_idle()
    listener, link = (socket.socket(fileno=int(number)) for number in sys.argv[1:3])
    settings = json.loads(link.recv(LARGEST) or b"null")
    if settings is None:
        return
    token = settings.pop("token")
    shown = Shown(**settings)
    server = Server(listener, type("PageHandler", (Handler,), {"shown": shown, "link": link, "token": token}))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    take_updates(link, int(sys.argv[3]), shown)


if __name__ == "__main__":
    main()
