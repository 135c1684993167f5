"""One simulated camera per loopback address: Aravis starts a second one there without complaint, and it is deaf."""

import errno
import re
import socket
import time
from pathlib import Path

from drivers.errors import CameraError

_CONTROL_PORT = 3956
_ADDRESSES = Path("/proc/net/fib_trie")


def loopback_addresses() -> list[str]:
    """Every address in 127.0.0.0/8 that an interface of this machine has."""
    try:
        text = _ADDRESSES.read_text()
    except OSError:
        return []
    return sorted(set(re.findall(r"\|-- (127\.\d+\.\d+\.\d+)\n\s+/32 host LOCAL", text)))


class LoopbackAddress:
    """An address held by at most one simulated camera of this machine at a time.

    An abstract socket is the lock: the kernel frees it whatever way the process ends, and it lives in the same
    network namespace as the port.

    Parameters
    ----------
    elsewhere : where another camera has the address, take any other loopback address of this machine; `address` is
        then the one that was taken.
    """

    def __init__(self, address: str, elsewhere: bool = False) -> None:
        self.address = address
        self._elsewhere = elsewhere
        self._socket: socket.socket | None = None

    def take(self, wait_s: float) -> None:
        """Wait until the address is free and hold it; harmless if it is held already.

        Raises CameraError: no interface has the address, or a camera kept it for longer than `wait_s`.
        """
        if self._socket is not None:
            return
        addresses = loopback_addresses()
        # Linux binds any 127.x.x.x, but a driver that looks for cameras asks at the addresses of interfaces.
        if self.address.startswith("127.") and addresses and self.address not in addresses:
            raise self._error("no network interface has that address", f"Add it: ip addr add {self.address}/8 dev lo")
        # Real time: another program may hold the address.
        deadline_s = time.monotonic() + wait_s
        while True:
            fallbacks = [entry for entry in addresses if entry != self.address] if self._elsewhere else []
            for address in (self.address, *fallbacks):
                if (bound := self._bound(address)) is not None:
                    self.address, self._socket = address, bound
                    return
            if time.monotonic() > deadline_s:
                raise self._error(
                    f"another camera had it for {wait_s:g} s",
                    "End the other simulated camera, or give this machine one more address for it: "
                    f"ip addr add 127.0.0.{2 + len(fallbacks)}/8 dev lo",
                )
            time.sleep(0.05)

    def _bound(self, address: str) -> socket.socket | None:
        """The lock of an address, None where another camera has it. Raises CameraError."""
        holder = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            holder.bind(f"\0umov simulated camera {address}")
            # Cameras that were started by other programs do not know our lock, but they have the port.
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind((address, _CONTROL_PORT))
        except OSError as error:
            holder.close()
            if error.errno == errno.EADDRINUSE:
                return None
            raise self._error(str(error.strerror), f"Add it: ip addr add {address}/8 dev lo") from error
        return holder

    def release(self) -> None:
        """Let the next camera have the address; releasing twice is harmless."""
        holder, self._socket = self._socket, None
        if holder is not None:
            holder.close()

    def _error(self, came_back: str, what_to_do: str) -> CameraError:
        return CameraError(f"start a simulated camera at {self.address}", came_back, what_to_do)
