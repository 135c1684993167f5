"""Instruments behind a device file that take and give whole messages: USB Test and Measurement Class (USBTMC).

Linux serves such an instrument as ``/dev/usbtmc0``: a write is one message, a read waits for one as long as the
kernel's own time limit says (``USBTMC_IOCTL_SET_TIMEOUT`` of ``linux/usb/tmc.h``). Any other file, such as the
pseudo-terminal of an emulator, is read when something is there.
"""

import errno
import fcntl
import os
import select
import struct
import threading
from pathlib import Path

from drivers.clock import REAL, Clock
from drivers.errors import PermissionRefused, PortBusy, PortLost, PortNotFound
from drivers.serial_link import line_framer
from drivers.serial_ports import HELD, end_the_holder, held_descriptor, port_holders

# _IOW(91, 10, __u32), milliseconds; the kernel takes no less than 100.
_SET_TIMEOUT = 0x40045B0A
_SHORTEST_MS = 100
_SLICE_S = 0.02


class MessageDevice:
    """An open device file, one message a line.

    Parameters
    ----------
    port : path of the device file.
    held_by : name of a program that may have it open too, a simulator.

    Raises
    ------
    PortNotFound, PortBusy, PermissionRefused
    """

    def __init__(self, port: str, clock: Clock = REAL, held_by: str | None = None) -> None:
        self.port = port
        self.clock = clock
        # One exchange at a time.
        self.lock = threading.RLock()
        action = f"open {port}"
        self._is_held = port.startswith(HELD)
        names = [name for pid, name in port_holders(port) if pid != os.getpid() and name != f"{held_by} (pid {pid})"]
        if names:
            raise PortBusy(action, f"it is in use by {', '.join(names)}", f"{end_the_holder(port)}; nothing was sent")
        try:
            if self._is_held:
                self._file = held_descriptor(port)
            else:
                self._file = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_CLOEXEC)
        except PermissionError as error:
            raise PermissionRefused(action, "this user may not", "Add a udev rule for the instrument") from error
        except OSError as error:
            ports = ", ".join(str(path) for path in sorted(Path("/dev").glob("usbtmc*"))) or "none"
            raise PortNotFound(action, str(error.strerror), f"USBTMC devices found: {ports}. Correct `port`") from error
        self._is_usbtmc = Path(os.path.realpath(port)).name.startswith("usbtmc")
        self._buffer = bytearray()

    def write(self, message: str) -> None:
        """Send one message."""
        try:
            os.write(self._file, f"{message}\n".encode("ascii"))
        except OSError as error:
            raise self._loss(error) from error

    def read(self, timeout_s: float) -> str | None:
        """The next message, without its line end (CR, LF or both); None if none comes in time."""
        end_s = self.clock.now_s() + timeout_s
        while (line := line_framer(self._buffer)) is None:
            if not self._is_usbtmc and not select.select([self._file], [], [], _SLICE_S)[0]:
                if self.clock.now_s() > end_s:
                    return None
                continue
            data = self._receive(timeout_s)
            if data is None:
                return None
            self._buffer += data
        return line.decode("ascii", "replace").strip()

    def _receive(self, timeout_s: float) -> bytes | None:
        try:
            if self._is_usbtmc:
                limit = struct.pack("I", max(_SHORTEST_MS, round(1000 * timeout_s)))
                fcntl.ioctl(self._file, _SET_TIMEOUT, limit)
            return os.read(self._file, 4096)
        except TimeoutError:
            return None
        except OSError as error:
            raise self._loss(error) from error

    def drop_input(self) -> None:
        """Discard pending input; an instrument on USBTMC keeps an answer until it is read."""
        self._buffer.clear()
        while not self._is_usbtmc and select.select([self._file], [], [], 0)[0]:
            if not self._receive(0):
                return

    def fileno(self) -> int:
        """The descriptor of the open device file."""
        return self._file

    def close(self) -> None:
        """Give the device back. Closing twice is harmless."""
        if self._file >= 0 and not self._is_held:
            os.close(self._file)
        self._file = -1

    def _loss(self, error: OSError) -> PortLost:
        reason = errno.errorcode.get(error.errno or 0, str(error))
        return PortLost(f"use {self.port}", f"it is gone ({reason})", "Check cable and power, then start again")
