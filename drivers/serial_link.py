"""Serial lines: one owner with one lock for each port, bounded waits, whole frames, a transcript on demand."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import os
import select
import struct
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

import serial

from drivers.clock import REAL, Clock
from drivers.errors import DeviceError, PermissionRefused, PortBusy, PortLost, PortNotFound, ReplyError

# A framer takes one whole frame off the front of the buffer, or returns None until there is one.
Framer = Callable[[bytearray], bytes | None]

# No protocol here has a longer frame; noise without an end is dropped beyond it.
LONGEST_FRAME = 1024
# Reads wait in slices, so that a deadline is met to within one slice.
READ_SLICE_S = 0.02
# Counted by the real clock: a machine that stands still for a moment is no lost port.
WRITE_S = 10.0


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


class Transcript:
    """Writes every byte on the wire to a text file, one line for each write and read."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="ascii")
        self._lock = threading.Lock()

    def note(self, mark: str, data: bytes) -> None:
        """Add a line: real time in seconds, `>>` sent or `<<` received, the bytes as text and hex."""
        text = data.decode("ascii", "backslashreplace").encode("unicode_escape").decode("ascii")
        with self._lock:
            self._file.write(f"{time.monotonic():.4f} {mark} {text} [{data.hex(' ')}]\n")
            self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class HeldPort:
    """A port that another process opened and handed over as a descriptor; it stays open when this is closed.

    A driver opens it under the address ``fd://NUMBER/dev/...``: the guard of `acquire` then needs neither the port's
    name nor the consent of the process that holds it.
    """

    rts = True

    def __init__(self, port: str) -> None:
        self._file = held_descriptor(port)

    def fileno(self) -> int:
        """The descriptor."""
        return self._file

    @property
    def in_waiting(self) -> int:
        """Bytes that wait to be read."""
        return int(struct.unpack("i", fcntl.ioctl(self._file, termios.FIONREAD, b"\0\0\0\0"))[0])

    def read(self, size: int) -> bytes:
        """At most `size` bytes, after READ_SLICE_S at most."""
        if not select.select([self._file], [], [], READ_SLICE_S)[0]:
            return b""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._file, size)
        return b""

    def write(self, data: bytes) -> None:
        """Send all bytes. Raises SerialTimeoutException if the device takes none for WRITE_S."""
        while data:
            if not select.select([], [self._file], [], WRITE_S)[1]:
                raise serial.SerialTimeoutException(f"it takes nothing for {WRITE_S:g} s")
            with contextlib.suppress(BlockingIOError):
                data = data[os.write(self._file, data) :]

    def reset_input_buffer(self) -> None:
        """Drop what waits to be read."""
        termios.tcflush(self._file, termios.TCIFLUSH)

    def close(self) -> None:
        """Nothing: whoever received the descriptor closes it."""


#: Start of the address of a port that was handed over.
HELD = "fd://"


def held_descriptor(port: str) -> int:
    """The descriptor in an address ``fd://NUMBER/dev/...``."""
    return int(port.removeprefix(HELD).partition("/")[0])


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
        self._serial: Any = _open_port(port, baudrate, held_by, xonxoff, rtscts, two_stop_bits)
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


def _open_port(port: str, baudrate: int, held_by: str | None, xonxoff: bool, rtscts: bool, two_stop_bits: bool) -> Any:
    asked = f"open port {port}"
    if port.startswith(HELD):
        return HeldPort(port)
    if "://" not in port:
        if not Path(port).exists():
            raise PortNotFound(asked, "there is no such port", _ports_hint())
        holders = [(pid, who) for pid, who in port_holders(port) if pid != os.getpid()]
        others = [who for pid, who in holders if who != f"{held_by} (pid {pid})"]
        if others:
            raise PortBusy(asked, f"it is in use by {', '.join(others)}", f"{end_the_holder(port)}; nothing was sent")
    try:
        options: dict[str, Any] = {} if "://" in port else {"exclusive": True}
        return serial.serial_for_url(
            port,
            baudrate=baudrate,
            stopbits=serial.STOPBITS_TWO if two_stop_bits else serial.STOPBITS_ONE,
            timeout=READ_SLICE_S,
            write_timeout=WRITE_S,
            xonxoff=xonxoff,
            rtscts=rtscts,
            **options,
        )
    except (serial.SerialException, OSError, ValueError) as error:
        number = getattr(error, "errno", None)
        if number in (errno.EACCES, errno.EPERM):
            raise PermissionRefused(
                asked, f"this user may not; {_owner(port)}", "Join that group and log in again"
            ) from error
        if number in (errno.EWOULDBLOCK, errno.EAGAIN, errno.EBUSY):
            named = ", ".join(who for _, who in port_holders(port)) or "a program that this user may not see"
            raise PortBusy(asked, f"it is in use by {named}", "End that program; nothing was sent") from error
        raise PortNotFound(asked, str(error), _ports_hint()) from error


def port_holders(port: str) -> list[tuple[int, str]]:
    """Find the processes that have a device open, as (pid, "name (pid N)"); touches no device.

    Only processes that this user may look into are seen.
    """
    wanted = os.path.realpath(port)
    holders = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            held = any(os.readlink(entry) == wanted for entry in (process / "fd").iterdir())
            if held:
                name = (process / "comm").read_text().strip()
                holders.append((int(process.name), f"{name} (pid {process.name})"))
        except OSError:
            continue
    return holders


def end_the_holder(port: str) -> str:
    """What to do about a program that has a port open."""
    if not os.path.realpath(port).startswith("/dev/pts/"):
        return "End that program"
    return "End that program or, if it is the simulator behind this port, write its name as `held_by` in the rig file"


def _owner(port: str) -> str:
    import grp

    status = os.stat(port)
    try:
        group = grp.getgrgid(status.st_gid).gr_name
    except KeyError:
        group = str(status.st_gid)
    return f"it belongs to group {group}"


def _ports_hint() -> str:
    from serial.tools.list_ports import comports

    # pyserial says "n/a" of what has no description.
    names = [e.device if e.description == "n/a" else f"{e.device} ({e.description})" for e in comports()]
    by_id = sorted(str(path) for path in Path("/dev/serial/by-id").glob("*"))
    found = ", ".join(names + by_id) or "none"
    return f"Serial ports found: {found}. Correct `port` in the rig file or plug the device in"


T = TypeVar("T")


def agreed(read: Callable[[], T]) -> T:
    """Read a constant until two readings in a row are equal.

    Raises
    ------
    ReplyError
        Four readings and no two in a row alike.
    """
    seen = [read()]
    while len(seen) < 4:
        seen.append(read())
        if seen[-1] == seen[-2]:
            return seen[-1]
    raise ReplyError("read a constant twice", f"readings differ: {seen}", "The line is disturbed: check the cable")


class Line(Protocol):
    """What a driver keeps for each port: something that can be closed."""

    def close(self) -> None:
        """Close the port."""


L = TypeVar("L", bound=Line)


class LineRegistry:
    """One owner for each port, shared by all axes on that line; closes what is left when it is closed.

    Parameters
    ----------
    transcript_folder : Path, optional
        Folder that gets one transcript of the wire for each port.
    clock : Clock
        What every driver on these lines counts its deadlines and pauses by.
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
            # What several axes share is an object of its own around the link.
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
