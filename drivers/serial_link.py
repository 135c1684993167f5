"""Serial lines: one owner with one lock for each port, bounded waits, whole frames, a transcript on demand."""

import contextlib
import errno
import io
import os
import select
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

import serial

from drivers.clock import REAL, Clock
from drivers.errors import DeviceError, PortBusy, PortLost, ReplyError
from drivers.log_process import LogProcess
from drivers.serial_ports import WRITE_S, open_port

# A framer takes one whole frame off the front of the buffer, or returns None until there is one.
Framer = Callable[[bytearray], bytes | None]

# No protocol here has a longer frame; noise without an end is dropped beyond it.
LONGEST_FRAME = 1024


def line_framer(buffer: bytearray) -> bytes | None:
    """Take one text line off the buffer: it ends with CR, LF or both; empty lines are skipped."""
    while True:
        ends = [end for end in (buffer.find(b"\r"), buffer.find(b"\n")) if end >= 0]
        if not ends:
            if len(buffer) > LONGEST_FRAME:
                buffer.clear()
            return None
        line = bytes(buffer[: min(ends)])
        del buffer[: min(ends) + 1]
        if line:
            return line


def framer_of(end: bytes) -> Framer:
    """A framer that takes everything up to `end` off the buffer, and that with it."""

    def take(buffer: bytearray) -> bytes | None:
        place = buffer.find(end)
        if place < 0:
            return None
        frame = bytes(buffer[:place])
        del buffer[: place + len(end)]
        return frame

    return take


class Transcript:
    """Writes every byte on the wire to a text file, one line for each write and read."""

    def __init__(self, path: Path) -> None:
        self._log = LogProcess(path)
        self.close = self._log.close

    def note(self, mark: str, data: bytes) -> None:
        """Add a line: real time in seconds, `>>` sent or `<<` received, the bytes as text and hex."""
        text = data.decode("ascii", "backslashreplace").encode("unicode_escape").decode("ascii")
        self._log.add(f"{time.monotonic():.4f} {mark} {text} [{data.hex(' ')}]\n")


class SerialLink:
    """An open port that reads whole frames.

    Opening takes the port for this process alone, drops what waits in it and sends nothing.

    Parameters
    ----------
    port : str
        Device path, ``/dev/serial/by-id`` path or ``socket://host:port``.
    baudrate : int
        Bits per second.
    framer : callable
        Takes one frame off the buffer.
    xonxoff, rtscts : bool
        Flow control.
    two_stop_bits : bool
        Two stop bits in place of one.
    transcript : Transcript, optional
        Where to log the wire.
    clock : Clock
        What deadlines are counted by.
    held_by : str, optional
        Name of a program that may have the port open too: the simulator at the other end of a pseudo-terminal.

    Raises
    ------
    PortNotFound, PortBusy, PermissionRefused
        With the path, the holder or the owning group.
    """

    def __init__(
        self,
        port: str,
        baudrate: int,
        framer: Framer,
        *,
        xonxoff: bool = False,
        rtscts: bool = False,
        two_stop_bits: bool = False,
        transcript: Transcript | None = None,
        clock: Clock = REAL,
        held_by: str | None = None,
    ) -> None:
        self.port = port
        self.clock = clock
        # One exchange at a time; a stop does not wait for it.
        self.lock = threading.RLock()
        self._write_lock = threading.Lock()
        self._framer = framer
        self._buffer = bytearray()
        self._transcript = transcript
        self._serial: Any = open_port(port, baudrate, held_by, xonxoff, rtscts=rtscts, two_stop_bits=two_stop_bits)
        self.purge(0.0)

    def write(self, data: bytes) -> None:
        """Send bytes; does not take `lock`, so that a stop can overtake a wait for a reply."""
        with self._write_lock, self._lost_port_named():
            if self._transcript is not None:
                self._transcript.note(">>", data)
            self._wait_for_room()
            self._serial.write(data)

    def _wait_for_room(self) -> None:
        """Wait as long as a device holds the line (XOFF, CTS); pyserial would try again and again, on a whole core."""
        with contextlib.suppress(io.UnsupportedOperation):
            _, ready, _ = select.select([], [self._serial.fileno()], [], WRITE_S)
            if not ready:
                raise serial.SerialTimeoutException(f"it takes nothing for {WRITE_S:g} s")

    def read_frame(self, deadline_s: float) -> bytes | None:
        """Return the next whole frame, or None if none is complete when `clock` shows `deadline_s`."""
        while True:
            frame = self._framer(self._buffer)
            if frame is not None:
                return frame
            left_s = deadline_s - self.clock.now_s()
            with self._lost_port_named():
                waiting = self._serial.in_waiting
                if waiting == 0 and left_s <= 0:
                    return None
                data = self._serial.read(max(1, waiting))
                if data and not waiting:
                    # The byte that ended the wait seldom comes alone.
                    data += self._serial.read(self._serial.in_waiting)
            if data and self._transcript is not None:
                self._transcript.note("<<", data)
            self._buffer += data

    def purge(self, quiet_s: float = 0.05) -> None:
        """Drop everything received until the line has been quiet for `quiet_s` (at most ten times as long)."""
        start_s = quiet_since_s = self.clock.now_s()
        with self._lost_port_named():
            self._serial.reset_input_buffer()
            self._buffer.clear()
            while (now_s := self.clock.now_s()) - quiet_since_s < quiet_s and now_s - start_s < 10 * quiet_s:
                if self._serial.read(max(1, self._serial.in_waiting)):
                    quiet_since_s = self.clock.now_s()

    def set_rts(self, level: bool) -> None:
        """Set the RTS line; a pseudo-terminal has none, which is fine."""
        try:
            self._serial.rts = level
        except OSError as error:
            if error.errno not in (errno.ENOTTY, errno.EINVAL):
                raise

    def fileno(self) -> int:
        """The descriptor of the open port."""
        return int(self._serial.fileno())

    def close(self) -> None:
        """Give the port back."""
        # pyserial leaves a socket open whose other end has gone.
        connection = getattr(self._serial, "_socket", None)
        with contextlib.suppress(OSError, serial.SerialException):
            self._serial.close()
        if connection is not None:
            connection.close()
        if self._transcript is not None:
            self._transcript.close()

    @contextlib.contextmanager
    def _lost_port_named(self) -> Any:
        try:
            yield
        except (OSError, serial.SerialException, termios.error, TypeError) as error:
            # termios.error is no OSError; pyserial raises TypeError when another thread closes the port in a read.
            raise PortLost(
                f"use port {self.port}", f"it is gone ({error})", "Check cable and power, then start again"
            ) from error


T = TypeVar("T")


def agreed(read: Callable[[], T]) -> T:
    """Read a constant until two readings in a row are equal.

    Raises ReplyError: four readings and no two in a row equal.
    """
    readings = [read()]
    while len(readings) < 4:
        readings.append(read())
        if readings[-1] == readings[-2]:
            return readings[-1]
    raise ReplyError("read a constant twice", f"readings differ: {readings}", "The line is disturbed: check the cable")


class PortConfig(Protocol):
    """What a rig file says of a port."""

    @property
    def port(self) -> str: ...
    @property
    def held_by(self) -> str | None: ...
    @property
    def reply_s(self) -> float | None: ...


class ControllerLine:
    """The port of one controller, shared by its axes.

    Parameters
    ----------
    config : of the first axis that is opened.
    clock, transcript, framer, options : as `SerialLink` takes them.
    reply_s : longest wait for a reply where the rig file gives none.
    """

    def __init__(
        self,
        config: PortConfig,
        clock: Clock,
        transcript: Transcript | None,
        framer: Framer,
        *,
        baudrate: int,
        reply_s: float,
        **options: bool,
    ) -> None:
        self.link = SerialLink(
            config.port, baudrate, framer, transcript=transcript, clock=clock, held_by=config.held_by, **options
        )
        self.reply_s = config.reply_s or reply_s

    def close(self) -> None:
        """Close the port."""
        self.link.close()


class Line(Protocol):
    """The object that a driver keeps for each port; it can be closed."""

    def close(self) -> None:
        """Close the port."""


L = TypeVar("L", bound=Line)


class LineRegistry:
    """One owner for each port, shared by all axes on that line; closes the remaining ports when it is closed.

    Parameters
    ----------
    transcript_folder : Path, optional
        Folder that gets one transcript of the wire for each port.
    clock : Clock
        Of the deadlines and pauses of every driver on these lines.
    """

    def __init__(self, transcript_folder: Path | None = None, clock: Clock = REAL) -> None:
        self.clock = clock
        self._folder = transcript_folder
        self._lines: dict[str, tuple[Line, int]] = {}
        self._lock = threading.Lock()

    def take(self, port: str, kind: type[L], make: Callable[[Transcript | None], L]) -> L:
        """Return the line on `port`, made by `make` if it is not open yet; give it back with `release`.

        Raises
        ------
        PortBusy
            The port is already open here for another protocol.
        """
        key = _port_key(port)
        with self._lock:
            line, users = self._lines.get(key, (None, 0))
            if line is None:
                line = make(self._transcript(key))
            if not isinstance(line, kind):
                raise PortBusy(
                    f"open port {port}",
                    f"this rig already uses it for {type(line).__name__}",
                    "Give each kind of controller its own port in the rig file",
                )
            self._lines[key] = (line, users + 1)
            return line

    @contextlib.contextmanager
    def taken(self, port: str, kind: type[L], make: Callable[[Transcript | None], L]) -> Iterator[L]:
        """Take a line for a device that is opened inside the block; it is given back if that fails."""
        line = self.take(port, kind, make)
        try:
            yield line
        except BaseException:
            self.release(port)
            raise

    def link(self, config: PortConfig, baudrate: int, framer: Framer) -> contextlib.AbstractContextManager[SerialLink]:
        """Take the port of a device that has it for itself, as `taken` does."""

        def make(transcript: Transcript | None) -> SerialLink:
            return SerialLink(
                config.port, baudrate, framer, transcript=transcript, clock=self.clock, held_by=config.held_by
            )

        return self.taken(config.port, SerialLink, make)

    def release(self, port: str) -> None:
        """Give a line back; the last user closes it."""
        key = _port_key(port)
        with self._lock:
            line, users = self._lines.pop(key, (None, 0))
            if line is None:
                return
            if users > 1:
                self._lines[key] = (line, users - 1)
            else:
                line.close()

    def descriptors(self) -> dict[str, int]:
        """Descriptors of the open device files, by path; of a network port there is none."""
        with self._lock:
            # Several axes share an object around the link.
            links = {key: getattr(line, "link", line) for key, (line, _) in self._lines.items() if "://" not in key}
        return {key: link.fileno() for key, link in links.items() if hasattr(link, "fileno")}

    def close(self) -> None:
        """Close every line that is still open."""
        with self._lock:
            lines = [line for line, _ in self._lines.values()]
            self._lines.clear()
        for line in lines:
            with contextlib.suppress(DeviceError):
                line.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _transcript(self, key: str) -> Transcript | None:
        if self._folder is None:
            return None
        self._folder.mkdir(parents=True, exist_ok=True)
        name = "".join(letter if letter.isalnum() else "_" for letter in key).strip("_")
        return Transcript(self._folder / f"{name}.log")


def _port_key(port: str) -> str:
    return port if "://" in port else os.path.realpath(port)
