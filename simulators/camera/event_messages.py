"""Events that a GigE Vision camera tells on its message channel: a command of the camera, answered by the host.

Registers and layout (EVENT_CMD) are those of Wireshark's public dissector. The host writes its port and its address; a
port of 0 closes the channel. Where it writes a time limit as well, each message wants an answer and is sent again so
many times as it allows.
"""

import contextlib
import socket
import struct
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

NUMBER_OF_CHANNELS, CAPABILITY = 0x0900, 0x0934
HOST_PORT, HOST_ADDRESS, TIMEOUT_MS, RETRIES = 0x0B00, 0x0B10, 0x0B14, 0x0B18
#: Of the capability register: EVENT_CMD is supported.
EVENTS_SUPPORTED = 0x8
_KEY, _ACK_WANTED, _EVENT, _EVENT_ACK = 0x42, 0x01, 0x00C0, 0x00C1
_LONGEST_WAIT_S = 5.0

Moment = Literal["started", "ended", "missed"]
#: What happens in a camera, by the names that SFNC and makers have for it.
EVENTS: dict[Moment, tuple[str, ...]] = {
    "started": ("FrameStart", "ExposureStart"),
    "ended": ("ExposureEnd",),
    "missed": ("FrameTriggerMissed", "FrameStartOvertrigger"),
}


class EventMessages:
    """The message channel of one camera.

    Parameters
    ----------
    register : callable
        Value of a bootstrap register of 32 bits.
    """

    def __init__(self, register: Callable[[int], int]) -> None:
        self._register = register
        self._number = 0
        # One after another, and not in the thread that exposes: the host may answer slowly.
        self._sender = ThreadPoolExecutor(1, "camera events")

    def tell(self, address: str, event: int, frame_id: int, time_ns: int) -> None:
        """Send an event, where a host listens; returns at once.

        Parameters
        ----------
        address : str
            Of the camera.
        event : int
            Its number.
        frame_id : int
            Of the frame it belongs to; 0 for none.
        time_ns : int
            By the camera's clock.
        """
        port = self._register(HOST_PORT) & 0xFFFF
        if port == 0:
            return
        host = socket.inet_ntoa(struct.pack(">I", self._register(HOST_ADDRESS)))
        wait_s = min(self._register(TIMEOUT_MS) * 1e-3, _LONGEST_WAIT_S)
        tries = 1 + self._register(RETRIES) if wait_s else 1
        # A request is never numbered 0.
        self._number = self._number % 0xFFFF + 1
        content = struct.pack(">HHHHQ", 0, event, 0, frame_id, time_ns)
        header = struct.pack(">BBHHH", _KEY, _ACK_WANTED if wait_s else 0, _EVENT, len(content), self._number)
        # The camera may have been unplugged meanwhile.
        with contextlib.suppress(RuntimeError):
            self._sender.submit(_send, header + content, (address, 0), (host, port), wait_s, tries=tries)

    def close(self) -> None:
        """Send no more; waits for the message that is under way."""
        self._sender.shutdown(cancel_futures=True)


def _send(message: bytes, camera: tuple[str, int], host: tuple[str, int], wait_s: float, *, tries: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
        channel.bind(camera)
        for _ in range(tries):
            channel.sendto(message, host)
            if not wait_s or _is_answered(channel, message[6:8], wait_s):
                return


def _is_answered(channel: socket.socket, number: bytes, wait_s: float) -> bool:
    end_s = time.monotonic() + wait_s
    while (left_s := end_s - time.monotonic()) > 0:
        channel.settimeout(left_s)
        try:
            answer = channel.recv(64)
        except OSError:
            # Nothing came, or no host listens any more.
            return False
        if answer[2:4] == struct.pack(">H", _EVENT_ACK) and answer[6:8] == number:
            return True
    return False
