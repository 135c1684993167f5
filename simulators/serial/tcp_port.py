"""Runs an emulator behind a TCP port, for controllers on the network that take several connections at once."""

import contextlib
import selectors
import socket
from typing import Any, Protocol

from simulators.clock import BEAT_S, patient_clock
from simulators.serial.emulator import Emulator
from simulators.serial.pty_port import PtyPort, SerialEmulator
from simulators.serial.served_port import ServedPort


class NetworkEmulator(Protocol):
    """The interface of an emulator that a TCP port needs: a new conversation for each connection."""

    def connect(self) -> SerialEmulator:
        """Begin a conversation."""


class TcpPort(ServedPort):
    """A TCP port on 127.0.0.1 served by one emulator; `path` is ``socket://127.0.0.1:PORT``."""

    def __init__(self, emulator: NetworkEmulator) -> None:
        self.emulator = emulator
        self._listener = socket.create_server(("127.0.0.1", 0))
        super().__init__(f"socket://127.0.0.1:{self._listener.getsockname()[1]}")

    def _release(self) -> None:
        self._listener.close()

    def _serve(self) -> None:
        talks: dict[socket.socket, SerialEmulator] = {}
        try:
            with patient_clock().attend() as check_in, selectors.DefaultSelector() as selector:
                selector.register(self._listener, selectors.EVENT_READ)
                selector.register(self._wake_read, selectors.EVENT_READ)
                while True:
                    check_in()
                    waits = [wait for talk in talks.values() if (wait := talk.next_output_s()) is not None]
                    events = selector.select(max(0.0, min([*waits, BEAT_S])))
                    for key, _ in events:
                        if key.fileobj == self._wake_read:
                            return
                        self._take(key.fileobj, talks, selector)
                    for connection, talk in talks.items():
                        # A client that has gone is noticed when it is read from.
                        with contextlib.suppress(ConnectionError):
                            connection.sendall(talk.take_output())
        finally:
            for connection in talks:
                connection.close()

    def _take(self, ready: Any, talks: dict[socket.socket, SerialEmulator], selector: Any) -> None:
        if ready is self._listener:
            connection, _ = self._listener.accept()
            talks[connection] = self.emulator.connect()
            selector.register(connection, selectors.EVENT_READ)
            return
        try:
            data = ready.recv(4096)
        except ConnectionError:
            data = b""
        if data:
            talks[ready].receive(data)
        else:
            selector.unregister(ready)
            del talks[ready]
            ready.close()


def port_for(emulator: Emulator) -> ServedPort:
    """A port of the kind that the controller has: TCP where it holds conversations, else a serial line."""
    return TcpPort(emulator) if hasattr(emulator, "connect") else PtyPort(emulator)
