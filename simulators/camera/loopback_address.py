"""One simulated camera per loopback address: Aravis starts a second one there without complaint, and it is deaf."""

from __future__ import annotations

import errno
import socket
import time

from drivers.errors import CameraError

_CONTROL_PORT = 3956


class LoopbackAddress:
    """An address held by at most one simulated camera of this machine at a time.

    An abstract socket is the lock: the kernel frees it whatever way the process ends, and it lives in the same
    network namespace as the port.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self._held: socket.socket | None = None

    def take(self, wait_s: float) -> None:
        """Wait until the address is free and hold it; harmless if it is held already.

        Raises
        ------
        CameraError
            No interface has the address, or a camera kept it for longer than `wait_s`.
        """
        if self._held is not None:
            return
        # Real time: whoever holds the address may be another program.
        deadline_s = time.monotonic() + wait_s
        while True:
            held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                held.bind(f"\0umov simulated camera {self.address}")
                # Cameras that were started by other programs do not know our lock, but they have the port.
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                    probe.bind((self.address, _CONTROL_PORT))
            except OSError as error:
                held.close()
                if error.errno != errno.EADDRINUSE:
                    raise self._error(str(error.strerror), f"Add it: ip addr add {self.address}/8 dev lo") from error
                if time.monotonic() > deadline_s:
                    raise self._error(
                        f"another camera had it for {wait_s:g} s", "End the other simulated camera or use 127.0.0.2"
                    ) from error
                time.sleep(0.05)
            else:
                self._held = held
                return

    def release(self) -> None:
        """Let the next camera have the address; releasing twice is harmless."""
        held, self._held = self._held, None
        if held is not None:
            held.close()

    def _error(self, came_back: str, what_to_do: str) -> CameraError:
        return CameraError(f"start a simulated camera at {self.address}", came_back, what_to_do)
