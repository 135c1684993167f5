"""A stream of frames from Aravis into memory of our own, pulled and never called back."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import UnknownPixelFormat
from drivers.pixel_formats import PixelFormat

# A frame with gaps is given up after this long; resend requests have had their chance by then.
_FRAME_RETENTION_US = 200_000
_PACKET_TIMEOUT_US = 20_000
_COUNTERS = ("n_completed_buffers", "n_failures", "n_underruns", "n_missing_packets", "n_resent_packets")


@dataclass(frozen=True, slots=True)
class Arrival:
    """A buffer that came out of the stream, whole or not.

    `memory` is only good until the arrival is given back. `frame_id` and `first_packet_s` (unix time) are 0 where
    the first packet of the frame was lost.
    """

    buffer: Any
    memory: NDArray[np.uint8]
    whole: bool
    status: str
    frame_id: int
    camera_time_ns: int
    first_packet_s: float

    def follows(self, last_id: int | None) -> bool:
        """False if this frame's number does not come after the last one seen.

        16-bit frame ids go from 65535 to 1; they are compared on that circle.
        """
        if last_id is None or self.frame_id == 0:
            return True
        return 0 < (self.frame_id - last_id) % 65535 < 65535 // 2

    def image_layout(self) -> tuple[int, int, int]:
        """Pixel format code, width and height as the camera announced them with this frame."""
        code = int(self.buffer.get_image_pixel_format()) & 0xFFFFFFFF
        return code, int(self.buffer.get_image_width()), int(self.buffer.get_image_height())


class FrameStream:
    """Buffers in numpy memory that go round between Aravis' receiving thread and us.

    Parameters
    ----------
    aravis, camera :
        The Aravis module and an open `Aravis.Camera`.
    payload_bytes : size of one frame.
    buffers : number of frames in flight.
    resend : ask a GigE Vision camera for missing packets again.
    """

    def __init__(self, aravis: Any, camera: Any, payload_bytes: int, buffers: int, *, resend: bool) -> None:
        self._aravis = aravis
        self._stream = camera.create_stream(None, None)
        if isinstance(self._stream, aravis.GvStream):
            policy = aravis.GvStreamPacketResend
            self._stream.set_property("packet-resend", policy.ALWAYS if resend else policy.NEVER)
            # As much of a frame as net.core.rmem_max allows, for the moments in which we are not scheduled.
            self._stream.set_property("socket-buffer", aravis.GvStreamSocketBuffer.AUTO)
            self._stream.set_property("frame-retention", _FRAME_RETENTION_US)
            self._stream.set_property("packet-timeout", _PACKET_TIMEOUT_US)
        self._memory: dict[int, NDArray[np.uint8]] = {}
        self._unread: Arrival | None = None
        for _ in range(buffers):
            memory = np.zeros(payload_bytes, np.uint8)
            buffer = aravis.Buffer.new(payload_bytes, memory.ctypes.data)
            # The hash of a GObject wrapper is the object's address: the same buffer comes back under it.
            self._memory[hash(buffer)] = memory
            self._stream.push_buffer(buffer)

    def take(self, timeout_s: float) -> Arrival | None:
        """Wait for the next buffer, at most `timeout_s` (under 0.1 s, so that Ctrl-C gets through); None if none."""
        unread, self._unread = self._unread, None
        if unread is not None:
            return unread
        if timeout_s > 0:
            buffer = self._stream.timeout_pop_buffer(int(min(timeout_s, 0.1) * 1e6))
        else:
            buffer = self._stream.try_pop_buffer()
        if buffer is None:
            return None
        status = buffer.get_status()
        return Arrival(
            buffer=buffer,
            memory=self._memory[hash(buffer)],
            whole=status == self._aravis.BufferStatus.SUCCESS,
            status=status.value_nick,
            frame_id=int(buffer.get_frame_id()),
            camera_time_ns=int(buffer.get_timestamp()),
            first_packet_s=buffer.get_system_timestamp() * 1e-9,
        )

    def unread(self, arrival: Arrival) -> None:
        """Let the next `take` return this arrival once more."""
        self._unread = arrival

    def give_back(self, arrival: Arrival) -> None:
        """Let the stream fill this buffer again; its memory must have been copied."""
        self._stream.push_buffer(arrival.buffer)

    def has_arrival(self) -> bool:
        """True if a buffer waits to be taken."""
        return self._unread is not None or bool(self._stream.get_n_buffers()[1])

    def counters(self) -> dict[str, int]:
        """Aravis' own counters of this stream, 0 where the transport has no such counter."""
        available = {self._stream.get_info_name(i) for i in range(self._stream.get_n_infos())}
        return {name: int(self._stream.get_info_uint64_by_name(name)) if name in available else 0 for name in _COUNTERS}

    def close(self) -> None:
        """Stop the receiving thread; nothing writes to our memory after that."""
        # Ours is the only reference, so this ends Aravis' thread; an explicit stop would make it complain later.
        self._stream = self._unread = None
        self._memory.clear()


def let_go(references: list[Any]) -> None:
    """Close the stream that comes first in the list, if any, and drop the last references to what follows it."""
    stream = references[0]
    if stream is not None:
        stream.close()
    references.clear()


def other_layout(arrival: Arrival, fmt: PixelFormat, size: tuple[int, int]) -> str | None:
    """How the format and the size that came with a frame differ from those set; None if they do not."""
    code, width, height = arrival.image_layout()
    if (code, width, height) == (fmt.code, *size):
        return None
    return (
        f"frame {arrival.frame_id} says code 0x{code:08x}, {width} x {height} pixels,"
        f" but 0x{fmt.code or 0:08x}, {size[0]} x {size[1]} was set"
    )


def counts_of(
    arrival: Arrival, fmt: PixelFormat, size: tuple[int, int], bits: int, *, shift: int, camera: str
) -> NDArray[np.uint16]:
    """Counts (rows, columns) of a whole frame, right-aligned, in memory of their own, read-only.

    Raises UnknownPixelFormat: the counts contradict `bits` and `shift` of the rig file.
    """
    pixels = fmt.decode(arrival.memory, *size, shift=shift)
    if misalignment := fmt.misalignment(arrival.memory, pixels, bits, shift):
        raise UnknownPixelFormat(
            f"{camera}, {fmt.name} with bits {bits} and shift {shift}",
            misalignment,
            "Correct `bits` and `shift` in the rig file; the camera's manual says how it aligns its data",
        )
    pixels.flags.writeable = False
    return pixels
