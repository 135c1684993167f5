"""The control protocol of GigE Vision (GVCP) as a camera answers it: discovery, registers, memory, control.

Numbers of commands and registers are those that Aravis and Wireshark's dissector have in public.
"""

import contextlib
import select
import socket
import struct
import threading
import time
from typing import Protocol

PORT = 3956
_KEY, _ACK_WANTED = 0x42, 0x01
_DISCOVERY, _RESEND, _READ_REGISTERS, _WRITE_REGISTERS, _READ_MEMORY, _WRITE_MEMORY = (
    0x0002,
    0x0040,
    0x0080,
    0x0082,
    0x0084,
    0x0086,
)
_DONE, _NOT_IMPLEMENTED, _ACCESS_DENIED = 0, 0x8001, 0x8006
# The answer to a discovery is the first registers as they are.
_DISCOVERY_BYTES = 0xF8
HEARTBEAT_MS, CONTROL = 0x0938, 0x0A00
_SLICE_S = 0.2

_Address = tuple[str, int]


class RegisterDevice(Protocol):
    """The camera behind the channel; called from the channel's thread."""

    def read(self, address: int, count: int) -> bytes:
        """Bytes from an address on."""

    def write(self, address: int, data: bytes) -> None:
        """Take bytes from an address on, and obey their commands."""

    def resend(self, frame_id: int, first: int, last: int) -> None:
        """Send packets of a frame once more."""

    def released(self) -> None:
        """Called when no program controls the camera any more."""


def _broadcast_sockets(address: str) -> list[socket.socket]:
    """Sockets for broadcasts, also of the subnet; fewer where another program has them alone."""
    sockets = []
    for everybody in ("255.255.255.255", address.split(".")[0] + ".255.255.255"):
        listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((everybody, PORT))
        except OSError:
            listener.close()
        else:
            sockets.append(listener)
    return sockets


class ControlChannel:
    """Answers at one address from `open` to `close`, in another thread."""

    def __init__(self, device: RegisterDevice) -> None:
        self._device = device
        self._socket: socket.socket | None = None
        self._listeners: list[socket.socket] = []
        self._thread: threading.Thread | None = None
        self._controller: _Address | None = None
        self._heard_s = 0.0

    def open(self, address: str) -> None:
        """Begin to answer. Raises OSError where the address cannot be had."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((address, PORT))
        except OSError:
            self._socket.close()
            raise
        # A program that looks for cameras asks everybody, and that arrives at other addresses than the camera's own.
        self._listeners = [self._socket, *_broadcast_sockets(address)]
        self._controller = None
        self._thread = threading.Thread(target=self._serve, args=(self._socket,), name=f"camera {address}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Answer no more; closing twice is harmless."""
        channel, self._socket = self._socket, None
        if channel is not None and self._thread is not None:
            # A packet of nobody ends the wait for the next one.
            with contextlib.suppress(OSError):
                channel.sendto(b"", channel.getsockname())
            self._thread.join()
            for sock in self._listeners:
                sock.close()

    def _serve(self, channel: socket.socket) -> None:
        while self._socket is channel:
            # What waits was sent while this thread had no turn: its sender was not silent.
            if not select.select([channel], [], [], 0)[0]:
                self._release_silent_controller()
            for sock in select.select(self._listeners, [], [], _SLICE_S)[0]:
                # The port of somebody who is gone; the next packet is another's. A packet that is too short for what it
                # says is nobody's command.
                with contextlib.suppress(struct.error, OSError):
                    packet, sender = sock.recvfrom(2048)
                    if sock is channel or packet[2:4] == struct.pack(">H", _DISCOVERY):
                        self._answer(channel, packet, sender)

    def _release_silent_controller(self) -> None:
        (allowed_ms,) = struct.unpack(">I", self._device.read(HEARTBEAT_MS, 4))
        if self._controller is not None and time.monotonic() - self._heard_s > allowed_ms * 1e-3:
            self._release()

    def _release(self) -> None:
        self._controller = None
        self._device.write(CONTROL, bytes(4))
        self._device.released()

    def _answer(self, channel: socket.socket, packet: bytes, sender: _Address) -> None:
        key, flags, command, size, number = struct.unpack_from(">BBHHH", packet)
        if key != _KEY:
            return
        if sender == self._controller:
            self._heard_s = time.monotonic()
        status, content = self._do(command, packet[8 : 8 + size], sender)
        if flags & _ACK_WANTED:
            channel.sendto(struct.pack(">HHHH", status, command + 1, len(content), number) + content, sender)

    def _do(self, command: int, content: bytes, sender: _Address) -> tuple[int, bytes]:
        device = self._device
        if command == _DISCOVERY:
            return _DONE, device.read(0, _DISCOVERY_BYTES)
        if command == _READ_REGISTERS:
            addresses = struct.unpack(f">{len(content) // 4}I", content)
            return _DONE, b"".join(device.read(address, 4) for address in addresses)
        if command == _READ_MEMORY:
            address, count = struct.unpack(">I2xH", content)
            return _DONE, content[:4] + device.read(address, count)
        if command == _RESEND:
            frame_id, first, last = struct.unpack_from(">2xHII", content)
            device.resend(frame_id, first & 0xFFFFFF, last & 0xFFFFFF)
            return _DONE, b""
        if command == _WRITE_REGISTERS:
            pairs = [(content[i : i + 4], content[i + 4 : i + 8]) for i in range(0, len(content) - 7, 8)]
            return self._write([(struct.unpack(">I", where)[0], data) for where, data in pairs], sender)
        if command == _WRITE_MEMORY:
            return self._write([(struct.unpack_from(">I", content)[0], content[4:])], sender)
        return _NOT_IMPLEMENTED, b""

    def _write(self, written: list[tuple[int, bytes]], sender: _Address) -> tuple[int, bytes]:
        for address, data in written:
            if address == CONTROL and self._controller in (None, sender):
                self._take_control(data, sender)
            elif self._controller == sender:
                self._device.write(address, data)
            else:
                return _ACCESS_DENIED, b""
        return _DONE, struct.pack(">2xH", len(written))

    def _take_control(self, data: bytes, sender: _Address) -> None:
        if any(data):
            self._controller, self._heard_s = sender, time.monotonic()
            self._device.write(CONTROL, data)
        elif self._controller == sender:
            self._release()
