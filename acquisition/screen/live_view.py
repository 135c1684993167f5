"""One local page that shows a run: progress, axes, last frame, quick look, source level, messages, a stop button.

The measuring thread only keeps references to what it has anyway; everything shown is computed when a browser asks,
in the browser's own thread. A slow browser, or none, costs the capture nothing.
"""

from __future__ import annotations

import json
import secrets
import threading
import time
from collections import deque
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from types import TracebackType
from typing import Any, ClassVar, Self
from urllib.parse import parse_qs, urlsplit

from acquisition.screen.live_images import dolp_png, histogram, last_frame_png, modulation_png, thinned
from acquisition.screen.observer import Mosaic, Observer, StateReport
from acquisition.stop_request import StopRequest
from processing.instrument.states import StateTable


class LiveState(Observer):
    """What the page shows, as references; safe to read from any thread."""

    def __init__(self, simulated: bool, black: float, full_scale: int) -> None:
        self.simulated = simulated
        self.black, self.full_scale = black, full_scale
        self._lock = threading.Lock()
        self._messages: deque[str] = deque(maxlen=50)
        self._monitor: deque[tuple[int, float]] = deque(maxlen=2000)
        self._report: StateReport | None = None
        self._mosaic: Mosaic | None = None
        # Every light state thinned out, for the quick look of a rotation: a copy, so that whole frames are let go.
        self._thin: deque[Any] = deque(maxlen=64)
        self._view: dict[str, Any] = {"title": "", "activity": "starting", "done": 0, "pending": 0, "status": "running"}
        # Real time, as everything that a person reads.
        self._start_s = time.monotonic()

    def campaign_progress(self, number: int, total: int, name: str) -> None:
        with self._lock:
            self._view |= {"campaign_done": number, "campaign_total": total, "campaign_capture": name}

    def run_started(self, title: str, table: StateTable, pending: int, mosaic: Mosaic | None) -> None:
        with self._lock:
            self._view |= {"title": title, "done": 0, "pending": pending, "status": "running"}
            self._monitor.clear()
            self._thin.clear()
            self._mosaic = mosaic
            self._start_s = time.monotonic()

    def activity(self, text: str) -> None:
        with self._lock:
            self._view["activity"] = text

    def state_done(self, report: StateReport) -> None:
        with self._lock:
            self._report = report
            self._view["done"] += 1
            self._view["activity"] = f"state {report.state} ({report.role})"
            if report.role != "dark":
                self._monitor.append((report.state, report.monitor))
                self._thin.append(thinned(report.pixels).copy())

    def warning(self, text: str) -> None:
        with self._lock:
            self._messages.append(f"{time.strftime('%H:%M:%S')} {text}")

    def run_ended(self, status: str, details: dict[str, Any]) -> None:
        with self._lock:
            self._view["status"] = status
            self._view["activity"] = status

    def snapshot(self) -> dict[str, Any]:
        """What the page asks for twice a second, ready for JSON."""
        with self._lock:
            view, report, mosaic = dict(self._view), self._report, self._mosaic
            messages, monitor = list(self._messages), list(self._monitor)
            elapsed_s = time.monotonic() - self._start_s
        done, pending = view["done"], view["pending"]
        view |= {
            "simulated": self.simulated,
            "quick": "modulation" if mosaic is None else "DoLP",
            "messages": messages[::-1],
            "monitor": monitor[-200:],
            "left_s": round(elapsed_s / done * (pending - done), 1) if done else None,
        }
        if report is not None:
            view |= {
                "frame": report.state,
                "axes": {name: round(position.deg, 4) for name, position in report.positions.items()},
                "exposure_s": report.exposure_s,
                "saturated": report.saturated_fraction,
                "near_black": report.near_black_fraction,
                "histogram": histogram(report.pixels, self.full_scale),
            }
        return view

    def frame_png(self) -> bytes | None:
        """The last frame; None before the first."""
        with self._lock:
            report = self._report
        return None if report is None else last_frame_png(report.pixels, self.black, self.full_scale)

    def quick_png(self) -> bytes | None:
        """DoLP of a mosaic frame, or modulation over the states so far; None before there is enough for it."""
        with self._lock:
            frames, mosaic, report = list(self._thin), self._mosaic, self._report
        if mosaic is not None:
            return None if report is None or report.role == "dark" else dolp_png(report.pixels, mosaic, self.black)
        return modulation_png(frames, self.black)


class LiveServer:
    """Serves a `LiveState` on loopback; a context manager.

    Attributes
    ----------
    url : address of the page with the token that its stop button needs.
    """

    def __init__(self, state: LiveState, stop: StopRequest, port: int = 0) -> None:
        self.state = state
        self._token = secrets.token_urlsafe(16)
        handler = type("Handler", (_Handler,), {"live": state, "stop": stop, "token": self._token})
        self._server = ThreadingHTTPServer(("127.0.0.1", port), handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, name="live view", daemon=True)
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/?token={self._token}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    live: ClassVar[LiveState]
    stop: ClassVar[StopRequest]
    token: ClassVar[str]
    # A browser that stops reading is given up, its thread ends.
    timeout = 10

    def do_GET(self) -> None:
        """Page, state and pictures."""
        path = urlsplit(self.path).path
        if not self._is_local():
            self._send(403, "text/plain", b"only for a browser on this machine")
        elif path == "/":
            self._send(
                200, "text/html; charset=utf-8", files("acquisition.screen").joinpath("live_view.html").read_bytes()
            )
        elif path == "/state":
            self._send(200, "application/json", json.dumps(self.live.snapshot()).encode())
        elif path in ("/frame.png", "/quick.png"):
            image = self.live.frame_png() if path == "/frame.png" else self.live.quick_png()
            self._send(200 if image else 404, "image/png", image or b"")
        else:
            self._send(404, "text/plain", b"there is no such page")

    def do_POST(self) -> None:
        """The stop button."""
        url = urlsplit(self.path)
        given = parse_qs(url.query).get("token", [""])[0]
        if not self._is_local() or not secrets.compare_digest(given.encode(), self.token.encode()):
            self._send(403, "text/plain", b"the token is missing or wrong")
        elif url.path == "/stop":
            self.live.warning("stop asked for on the live page")
            self.stop.request()
            self._send(200, "text/plain", b"stopping")
        else:
            self._send(404, "text/plain", b"there is no such action")

    def _is_local(self) -> bool:
        # Another site that resolves its name to this machine sends its own name as host.
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        return host in ("127.0.0.1", "localhost")

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
