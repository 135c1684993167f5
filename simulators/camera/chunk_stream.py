"""Frames with chunks behind the image, sent as GigE Vision has it: Aravis' fake camera sends images alone.

A frame is a leader, its bytes in packets, and a trailer; each chunk ends with its number and its length.
"""

from __future__ import annotations

import random
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from simulators.camera.camera_memory import CameraMemory
from simulators.camera.gige_features import TIMESTAMP_CHUNK

# Bootstrap registers of the stream channel.
HOST_PORT, PACKET_SIZE, HOST_ADDRESS = 0xD00, 0xD04, 0xD18
IMAGE_WITH_CHUNKS = 0x4001
LEADER, TRAILER, DATA = 1, 2, 3
# Of IP, UDP and GVSP.
HEADER_BYTES = 20 + 8 + 8
IMAGE_CHUNK = 1


@dataclass(frozen=True, slots=True)
class ChunkFrame:
    """One frame: its number, when its exposure began (ns of the camera's clock), format code, region and image.

    `tells_time` False leaves the time's chunk out, as a camera does that has lost it.
    """

    frame_id: int
    time_ns: int
    code: int
    region: tuple[int, int, int, int]
    image: bytes
    tells_time: bool = True

    def payload(self) -> bytes:
        """Image and chunks, each followed by its number and length."""
        chunks = {IMAGE_CHUNK: self.image}
        if self.tells_time:
            chunks[TIMESTAMP_CHUNK] = struct.pack(">Q", self.time_ns)
        return b"".join(data + struct.pack(">II", number, len(data)) for number, data in chunks.items())

    def packets(self, packet_bytes: int) -> Iterator[bytes]:
        """The packets, without their IP and UDP headers."""
        left, top, width, height = self.region
        numbers = (self.time_ns, self.code, width, height, left, top, 0, 0)
        yield self._packet(LEADER, 0, struct.pack(">HHQIIIIIHH", 0, IMAGE_WITH_CHUNKS, *numbers))
        payload, size = self.payload(), packet_bytes - HEADER_BYTES
        count = -(-len(payload) // size)
        for k in range(count):
            yield self._packet(DATA, k + 1, payload[k * size : (k + 1) * size])
        yield self._packet(TRAILER, count + 1, struct.pack(">II", IMAGE_WITH_CHUNKS, height))

    def _packet(self, kind: int, number: int, content: bytes) -> bytes:
        return struct.pack(">HHI", 0, self.frame_id, kind << 24 | number) + content


def send(frame: ChunkFrame, memory: CameraMemory, address: str, lost_ratio: float) -> None:
    """Send a frame to where the controlling host wants it; loses that part of the packets."""
    host = socket.inet_ntoa(struct.pack(">I", memory.read(HOST_ADDRESS)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
        channel.bind((address, 0))
        for packet in frame.packets(memory.read(PACKET_SIZE) & 0xFFFF):
            if random.random() >= lost_ratio:
                channel.sendto(packet, (host, memory.read(HOST_PORT) & 0xFFFF))
