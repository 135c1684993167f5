"""A device that plays a transcript: exactly these requests, in this order, get these replies."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from drivers.serial_link import LineRegistry
from simulators.clock import patient_clock
from simulators.serial.pty_port import PtyPort, SerialEmulator


class Script:
    """A device that expects exactly these requests in this order and gives these replies."""

    def __init__(self, pairs: list[tuple[bytes, bytes]]) -> None:
        self.pairs = list(pairs)
        self.received = b""
        self.output = b""

    def receive(self, data: bytes) -> None:
        self.received += data
        while self.pairs and self.received.startswith(self.pairs[0][0]):
            request, reply = self.pairs.pop(0)
            self.received = self.received[len(request) :]
            self.output += reply

    def take_output(self) -> bytes:
        output, self.output = self.output, b""
        return output

    def next_output_s(self) -> float | None:
        return None


@contextmanager
def served(device: SerialEmulator) -> Iterator[tuple[str, LineRegistry]]:
    """The port of a device, and the lines to open it with."""
    with PtyPort(device) as port, LineRegistry(clock=patient_clock()) as lines:
        yield port.path, lines


@contextmanager
def scripted(*pairs: tuple[bytes, bytes]) -> Iterator[tuple[str, LineRegistry]]:
    """The port of a device that plays `pairs`, and the lines to open it with; a pair that is not used fails."""
    script = Script(list(pairs))
    with served(script) as opened:
        yield opened
        give_up_s = patient_clock().now_s() + 1.0
        while script.pairs and patient_clock().now_s() < give_up_s:
            time.sleep(0.01)
    assert (script.pairs, script.received) == ([], b"")
