"""Runs an emulator behind a pseudo-terminal, so that any serial client can open it like a real port."""

from __future__ import annotations

import errno
import os
import pty
import select
import threading
import time
import tty
from types import TracebackType
from typing import Protocol, Self

from simulators.clock import BEAT_S, patient_clock


class SerialEmulator(Protocol):
    """What a port needs of an emulator."""

    def receive(self, data: bytes) -> None:
        """Take bytes from the host, in any portions."""

    def take_output(self) -> bytes:
        """Return the bytes that are due for the host now."""

    def next_output_s(self) -> float | None:
        """Seconds until more output can be due, asked again when they are over; None if only input can cause some."""


class PtyPort:
    """A pseudo-terminal served by one emulator in a thread; clients may come and go.

    Attributes
    ----------
    path : str
        Path of the port, for the client.
    """

    def __init__(self, emulator: SerialEmulator) -> None:
        self.emulator = emulator
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        # Our own handle on the slave would look like a program that holds the port.
        os.close(slave)
        os.set_blocking(self._master, False)
        self._wake_read, self._wake_write = os.pipe()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._serve, name=f"emulator {self.path}", daemon=True)
        self._thread.start()

    def is_serving(self) -> bool:
        """True until it is closed or the emulator fails."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Stop serving and remove the port.

        Raises
        ------
        RuntimeError
            The emulator itself failed while it served.
        """
        if self._thread.is_alive():
            os.write(self._wake_write, b"x")
            self._thread.join()
        for descriptor in (self._master, self._wake_read, self._wake_write):
            if descriptor >= 0:
                os.close(descriptor)
        self._master = self._wake_read = self._wake_write = -1
        error, self._error = self._error, None
        if error is not None:
            raise RuntimeError(f"the emulator on {self.path} failed") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _serve(self) -> None:
        try:
            with patient_clock().attend() as here:
                pending = b""
                while True:
                    here()
                    pending = (pending + self.emulator.take_output())[-65536:]
                    wait_s = self.emulator.next_output_s()
                    readable, _, _ = select.select(
                        [self._master, self._wake_read],
                        [],
                        [],
                        BEAT_S if wait_s is None else max(0.0, min(wait_s, BEAT_S)),
                    )
                    if self._wake_read in readable:
                        return
                    if self._master in readable:
                        data = self._read()
                        if data is None:
                            # Nobody has the port open: what is not yet sent is lost, as on a cable without a host.
                            pending = b""
                            time.sleep(BEAT_S)
                        else:
                            self.emulator.receive(data)
                    pending = self._send(pending + self.emulator.take_output())
        except BaseException as error:  # noqa: BLE001 - raised again by close()
            # Kept for close(), which raises it in the thread that owns the port.
            self._error = error

    def _read(self) -> bytes | None:
        try:
            return os.read(self._master, 4096)
        except BlockingIOError:
            return b""
        except OSError as error:
            if error.errno == errno.EIO:
                return None
            raise

    def _send(self, data: bytes) -> bytes:
        if not data:
            return b""
        try:
            return data[os.write(self._master, data) :]
        except BlockingIOError:
            return data
        except OSError as error:
            if error.errno == errno.EIO:
                return b""
            raise
