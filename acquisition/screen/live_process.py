"""The process that serves the live page: ``python -m acquisition.screen.live_process LISTENER LINK MEMORY``.

It takes no time from the measurement: it runs only when nothing else wants to, answers a few browsers at a time, and
draws a picture once however many ask for it. Nothing is given without the token.
"""

import asyncio
import contextlib
import json
import mmap
import os
import secrets
import socket
import sys
import threading
from collections.abc import Callable
from http import HTTPStatus
from importlib.resources import files
from typing import Any, ClassVar, TypeVar
from urllib.parse import parse_qs, urlsplit

import numpy as np
from numpy.typing import NDArray

from acquisition.screen.live_images import Modulation, dolp_png, histogram, last_frame_png
from processing.reports.design import style

Frame = NDArray[np.uint16]
Drawn = TypeVar("Drawn")

#: Browsers answered at the same time; others get a request to try again.
CLIENTS = 8
#: Connections whose request is not there yet; fewer than a process may have open.
WAITING = 256
#: Connections that the system takes before we do.
BACKLOG = 1024
#: Largest request without its body, bytes.
LONGEST_HEAD = 1 << 14
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
        """The state that the page requests twice a second, ready for JSON."""
        with self._lock:
            view = dict(self._view)
            frame = self._frame
        quick = "modulation" if view.pop("mosaic", None) is None else "DoLP"
        view |= {"simulated": self._simulated, "quick": quick, "full_scale": self._full_scale}
        if frame is not None:
            view["histogram"] = self._draw_once("histogram", lambda: histogram(frame, self._full_scale))
        return view

    def picture(self, name: str) -> bytes | None:
        """The last frame or the quick look as PNG; None while there is not enough for it."""
        with self._lock:
            frame, view, modulation = self._frame, dict(self._view), self._modulation.drawing(self._black)
        if frame is None:
            return None
        if name == "frame.png":
            return self._draw_once(name, lambda: last_frame_png(frame, self._black, self._full_scale))
        mosaic = view.get("mosaic")
        if mosaic is None:
            return self._draw_once(name, modulation)
        if view["role"] == "dark":
            return None
        return self._draw_once(name, lambda: dolp_png(frame, mosaic, self._black))

    def _draw_once(self, name: str, draw: Callable[[], Drawn]) -> Drawn:
        # Under the lock of its own pictures: a second browser waits for the first one's instead of drawing again.
        pictures = self._drawn
        with self._drawing:
            if name not in pictures:
                pictures[name] = draw()
            picture: Drawn = pictures[name]
            return picture

    _drawing: ClassVar[threading.Lock] = threading.Lock()


class Page:
    """Answers browsers: page, state, pictures and the stop button.

    Whoever connects waits without taking a place until the whole request is there, with the token; the longest waiting
    gives way to the newest. The stop button needs no place at all.

    Parameters
    ----------
    link : to the measuring program.
    """

    def __init__(self, shown: Shown, link: socket.socket, token: str) -> None:
        self._shown, self._link, self._token = shown, link, token.encode()
        self._waiting: dict[asyncio.StreamWriter, None] = {}
        self._clients = 0

    async def serve(self, listener: socket.socket) -> None:
        """Serve for ever."""
        server = await asyncio.start_server(self._meet, sock=listener, limit=LONGEST_HEAD, backlog=BACKLOG)
        await server.serve_forever()

    async def _meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # A browser that goes away in mid-sentence is no news.
        with contextlib.suppress(OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            self._waiting[writer] = None
            if len(self._waiting) > WAITING:
                oldest = next(iter(self._waiting))
                del self._waiting[oldest]
                oldest.transport.abort()
            try:
                head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), PATIENCE_S)
            finally:
                self._waiting.pop(writer, None)
            await asyncio.wait_for(self._answer(head.decode("latin-1"), writer), PATIENCE_S)
            # The body is discarded; if closed at once, the browser would not read the answer.
            writer.write_eof()
            async with asyncio.timeout(PATIENCE_S):
                while await reader.read(LONGEST_HEAD):
                    pass
        writer.transport.abort()

    async def _answer(self, head: str, writer: asyncio.StreamWriter) -> None:
        try:
            first, *lines = head.split("\r\n")
            method, target, _ = first.split(" ")
            url = urlsplit(target)
        except ValueError:
            await _send(writer, 400, "text/plain", b"no request")
            return
        headers = {name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
        refusal = self._refusal(method, headers, parse_qs(url.query).get("token", [""])[0])
        if refusal is not None:
            await _send(writer, 403, "text/plain", refusal)
        elif (method, url.path) == ("POST", "/stop"):
            self._link.send(b"stop")
            await _send(writer, 200, "text/plain", b"stopping")
        elif method != "GET":
            await _send(writer, 404, "text/plain", b"there is no such action")
        elif self._clients >= CLIENTS:
            await _send(writer, 503, "text/plain", b"", more="Retry-After: 1\r\n")
        else:
            self._clients += 1
            try:
                await _send(writer, *await asyncio.to_thread(self._content, url.path))
            finally:
                self._clients -= 1

    def _refusal(self, method: str, headers: dict[str, str], token: str) -> bytes | None:
        """The answer to a request without the token, or from a page of another site."""
        host = headers.get("host", "")
        # Another site that resolves its name to this machine sends its own name as host.
        if host.rsplit(":", 1)[0] not in ("127.0.0.1", "localhost"):
            return b"only for a browser on this machine"
        if not secrets.compare_digest(token.encode(errors="replace"), self._token):
            return b"the token is missing or wrong"
        origin = headers.get("origin")
        if origin != f"http://{host}" and not (origin is None and method == "GET"):
            return b"asked for by a page of another site"
        return None

    def _content(self, path: str) -> tuple[int, str, bytes]:
        if path == "/":
            page = files("acquisition.screen").joinpath("live_view.html").read_text(encoding="utf-8")
            return 200, "text/html; charset=utf-8", page.replace("/* design */", style()).encode()
        if path == "/state":
            return 200, "application/json", json.dumps(self._shown.snapshot()).encode()
        if path in ("/frame.png", "/quick.png"):
            image = self._shown.picture(path[1:])
            return (200 if image else 404), "image/png", image or b""
        return 404, "text/plain", b"there is no such page"


async def _send(writer: asyncio.StreamWriter, code: int, kind: str, body: bytes, *, more: str = "") -> None:
    head = (
        f"HTTP/1.1 {code} {HTTPStatus(code).phrase}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n"
        "Cache-Control: no-store\r\nReferrer-Policy: no-referrer\r\nConnection: close\r\n"
        "Content-Security-Policy: default-src 'none'; img-src 'self'; style-src 'unsafe-inline'; "
        f"script-src 'unsafe-inline'; connect-src 'self'\r\n{more}\r\n"
    )
    writer.write(head.encode() + body)
    await writer.drain()


def take_updates(link: socket.socket, memory: int, shown: Shown) -> None:
    """Receive updates of the measuring program until it has ended."""
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
    """Run at the lowest priority: the idle class, or the highest niceness where the system has no such class."""
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
    page = Page(shown, link, token)
    threading.Thread(target=lambda: asyncio.run(page.serve(listener)), daemon=True).start()
    take_updates(link, int(sys.argv[3]), shown)


if __name__ == "__main__":
    main()
