"""A frame in packets as GigE Vision has it: a leader, its bytes, a trailer; with or without chunks behind the image.

Each chunk ends with its number and its length.
"""

import random
import socket
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass

# Bootstrap registers of the stream channel.
HOST_PORT, PACKET_SIZE, HOST_ADDRESS = 0xD00, 0xD04, 0xD18
IMAGE, IMAGE_WITH_CHUNKS = 0x0001, 0x4001
LEADER, TRAILER, DATA = 1, 2, 3
# Of IP and UDP, and of GVSP behind them.
TRANSPORT_BYTES, STREAM_BYTES = 20 + 8, 8
IMAGE_CHUNK = 1
# Smaller packets would hold no data.
_LEAST_PACKET_BYTES = 64


def with_chunks(image: bytes, chunks: dict[int, bytes]) -> bytes:
    """Image and chunks by their numbers, each followed by its number and length."""
    parts = {IMAGE_CHUNK: image, **chunks}
    return b"".join(data + struct.pack(">II", number, len(data)) for number, data in parts.items())


@dataclass(frozen=True, slots=True)
class FramePackets:
    """One frame: its number, when its exposure began (ns of the camera's clock), format code, region and bytes.

    `region` is left, top, width and height; `chunked` says that the bytes are those of `with_chunks`.
    """

    frame_id: int
    time_ns: int
    code: int
    region: tuple[int, int, int, int]
    payload: bytes
    chunked: bool = False

    def packets(self, packet_bytes: int) -> Iterator[tuple[bytes, memoryview | bytes]]:
        """Header and content of the packets, without their IP and UDP headers."""
        left, top, width, height = self.region
        kind = IMAGE_WITH_CHUNKS if self.chunked else IMAGE
        numbers = (self.time_ns, self.code, width, height, left, top, 0, 0)
        yield self._packet(LEADER, 0, struct.pack(">HHQIIIIIHH", 0, kind, *numbers))
        size = packet_bytes - TRANSPORT_BYTES - STREAM_BYTES
        count = -(-len(self.payload) // size)
        payload = memoryview(self.payload)
        for k in range(count):
            yield self._packet(DATA, k + 1, payload[k * size : (k + 1) * size])
        yield self._packet(TRAILER, count + 1, struct.pack(">II", kind, height))

    def _packet(self, kind: int, number: int, content: memoryview | bytes) -> tuple[bytes, memoryview | bytes]:
        return struct.pack(">HHI", 0, self.frame_id, kind << 24 | number), content


def send(
    frame: FramePackets,
    register: Callable[[int], int],
    address: str,
    lost_ratio: float,
    *,
    numbers: range | None = None,
) -> None:
    """Send a frame from an address to where the controlling host wants it; loses that part of the packets.

    Parameters
    ----------
    register : value of a bootstrap register of 32 bits.
    numbers : the packets to send, by their numbers in the frame; all where it is left out.
    """
    host = socket.inet_ntoa(struct.pack(">I", register(HOST_ADDRESS)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
        channel.bind((address, 0))
        receiver = (host, register(HOST_PORT) & 0xFFFF)
        for number, packet in enumerate(frame.packets(max(register(PACKET_SIZE) & 0xFFFF, _LEAST_PACKET_BYTES))):
            if (numbers is None or number in numbers) and random.random() >= lost_ratio:
                channel.sendmsg(packet, (), 0, receiver)


def send_test_packet(register: Callable[[int], int], address: str) -> None:
    """Send one packet of the size that the controlling host wants, with which it sees whether that gets through."""
    host = socket.inet_ntoa(struct.pack(">I", register(HOST_ADDRESS)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
        channel.bind((address, 0))
        size = max(0, (register(PACKET_SIZE) & 0xFFFF) - TRANSPORT_BYTES)
        channel.sendto(bytes(size), (host, register(HOST_PORT) & 0xFFFF))
