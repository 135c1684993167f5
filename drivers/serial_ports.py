"""Serial ports: opening one, programs that have it open, and ports that another process hands over."""

import contextlib
import errno
import fcntl
import os
import select
import struct
import termios
from pathlib import Path
from typing import Any

import serial

from drivers.errors import PermissionRefused, PortBusy, PortNotFound

# Reads wait in slices, so that a deadline is met to within one slice.
READ_SLICE_S = 0.02
# Counted by the real clock: a machine that stands still for a moment is no lost port.
WRITE_S = 10.0


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
        """Do nothing: the receiver of the descriptor closes it."""


#: Start of the address of a port that was handed over.
HELD = "fd://"


def held_descriptor(port: str) -> int:
    """The descriptor in an address ``fd://NUMBER/dev/...``."""
    return int(port.removeprefix(HELD).partition("/")[0])


def open_port(
    port: str, baudrate: int, held_by: str | None, xonxoff: bool, *, rtscts: bool, two_stop_bits: bool
) -> Any:
    """Open a port or an address as pyserial knows them; the port alone, and for this program alone.

    Raises PortNotFound, PortBusy, PermissionRefused.
    """
    action = f"open port {port}"
    if port.startswith(HELD):
        return HeldPort(port)
    if "://" not in port:
        if not Path(port).exists():
            raise PortNotFound(action, "there is no such port", _ports_hint())
        holders = [(pid, who) for pid, who in port_holders(port) if pid != os.getpid()]
        names = [who for pid, who in holders if who != f"{held_by} (pid {pid})"]
        if names:
            raise PortBusy(action, f"it is in use by {', '.join(names)}", f"{end_the_holder(port)}; nothing was sent")
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
                action, f"this user may not; {_owner(port)}", "Join that group and log in again"
            ) from error
        if number in (errno.EWOULDBLOCK, errno.EAGAIN, errno.EBUSY):
            programs = ", ".join(who for _, who in port_holders(port)) or "a program that this user may not see"
            raise PortBusy(action, f"it is in use by {programs}", "End that program; nothing was sent") from error
        raise PortNotFound(action, str(error), _ports_hint()) from error


def port_holders(port: str) -> list[tuple[int, str]]:
    """Find the processes that have a device open, as (pid, "name (pid N)"); touches no device.

    Only processes that this user may look into are seen.
    """
    target = os.path.realpath(port)
    holders = []
    # By names, not by paths: a machine has some hundred processes with some ten files each.
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            folder = f"/proc/{pid}/fd"
            if any(os.readlink(f"{folder}/{number}") == target for number in os.listdir(folder)):
                name = Path(f"/proc/{pid}/comm").read_text().strip()
                holders.append((int(pid), f"{name} (pid {pid})"))
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
    ports = ", ".join(names + by_id) or "none"
    return f"Serial ports found: {ports}. Correct `port` in the rig file or plug the device in"
