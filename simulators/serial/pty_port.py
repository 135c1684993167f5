"""Runs an emulator behind a pseudo-terminal, so that any serial client can open it like a real port."""

import errno
import os
import pty
import select
import time
import tty
from typing import Protocol

from simulators.clock import BEAT_S, patient_clock
from simulators.serial.served_port import ServedPort


class SerialEmulator(Protocol):
    """The interface of an emulator that a port needs."""

    def receive(self, data: bytes) -> None:
        """Take bytes from the host, in any portions."""

    def take_output(self) -> bytes:
        """Return the bytes that are due for the host now."""

    def next_output_s(self) -> float | None:
        """Seconds until more output can be due, asked again when they are over; None if only input can cause some."""


class PtyPort(ServedPort):
    """A pseudo-terminal served by one emulator; `path` is that of its device file."""

    def __init__(self, emulator: SerialEmulator) -> None:
        self.emulator = emulator
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        path = os.ttyname(slave)
        # Our own handle on the slave would look like a program that holds the port.
        os.close(slave)
        os.set_blocking(self._master, False)
        super().__init__(path)

    def _release(self) -> None:
        if self._master >= 0:
            os.close(self._master)
        self._master = -1

    def _serve(self) -> None:
        with patient_clock().attend() as check_in:
            pending = b""
            while True:
                check_in()
                pending = (pending + self.emulator.take_output())[-65536:]
                wait_s = self.emulator.next_output_s()
                readable, _, _ = select.select(
                    [self._master, self._wake_read], [], [], BEAT_S if wait_s is None else max(0.0, min(wait_s, BEAT_S))
                )
                if self._wake_read in readable:
                    return
                if self._master in readable:
                    data = self._read()
                    if data is None:
                        # The port is not open: unsent bytes are lost, as on a cable without a host.
                        pending = b""
                        time.sleep(BEAT_S)
                    else:
                        self.emulator.receive(data)
                pending = self._send(pending + self.emulator.take_output())

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
