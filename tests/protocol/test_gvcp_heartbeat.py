"""Who controls an emulated camera keeps it while it beats, also where the camera's thread has no turn for a while."""

import socket
import struct
import time

import pytest

from simulators.camera.control_channel import CONTROL, HEARTBEAT_MS, PORT, ControlChannel

SLOW = 0x0500
ADDRESS = "127.44.3.9"


class SlowCamera:
    """Registers, of which one takes longer to read than the heartbeat may pause."""

    def __init__(self) -> None:
        self.memory, self.lost = bytearray(0x1000), False
        self.memory[HEARTBEAT_MS : HEARTBEAT_MS + 4] = struct.pack(">I", 200)

    def read(self, address: int, count: int) -> bytes:
        if address == SLOW:
            time.sleep(0.5)
        return bytes(self.memory[address : address + count])

    def write(self, address: int, data: bytes) -> None:
        self.memory[address : address + len(data)] = data

    def resend(self, frame_id: int, first: int, last: int) -> None: ...

    def released(self) -> None:
        self.lost = True


@pytest.fixture
def camera():
    device = SlowCamera()
    channel = ControlChannel(device)
    channel.open(ADDRESS)
    yield device
    channel.close()


def test_beats_that_wait_to_be_read_are_beats(camera):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5)

        def send(command: int, content: bytes) -> None:
            client.sendto(struct.pack(">BBHHH", 0x42, 1, command, len(content), 1) + content, (ADDRESS, PORT))

        def beat() -> None:
            send(0x0080, struct.pack(">I", CONTROL))

        send(0x0082, struct.pack(">II", CONTROL, 2))
        client.recv(2048)
        send(0x0080, struct.pack(">I", SLOW))
        beat()
        client.recv(2048)
        client.recv(2048)
        assert not camera.lost
        # Without beats it is let go.
        end_s = time.monotonic() + 5
        while not camera.lost and time.monotonic() < end_s:
            time.sleep(0.05)
        assert camera.lost
