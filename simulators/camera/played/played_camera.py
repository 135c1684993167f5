"""A simulated camera that serves a maker's GenICam description as it is and does what its features say.

Registers are memory; a few features are played by their standard (SFNC) names: region, pixel format, exposure, gain,
triggers, acquisition, status, time stamps behind the image. What a description says beyond them, a program can set
and read back. Control and stream protocol are our own here: Aravis' fake camera has 64 KiB of registers, and those of
the makers stand all over 32 bits.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections import deque
from pathlib import Path

from drivers.errors import CameraError
from drivers.pixel_formats import pixel_format_of
from simulators.camera.event_messages import EventMessages, Moment
from simulators.camera.exposure import PixelSource, counts_of
from simulators.camera.frame_packets import (
    HOST_ADDRESS,
    HOST_PORT,
    PACKET_SIZE,
    TRANSPORT_BYTES,
    FramePackets,
    send,
    with_chunks,
)
from simulators.camera.played.bootstrap import boot
from simulators.camera.played.control_channel import ControlChannel
from simulators.camera.played.description_file import read_description
from simulators.camera.played.features import LOADS, START, STOP, TRIGGER, Features
from simulators.camera.played.formula import Number
from simulators.camera.played.image_settings import delay_s, exposed, processed
from simulators.camera.played.node_tree import REGISTERS, NodeError, NodeTree
from simulators.camera.played.power_up import power_up
from simulators.camera.played.register import RegisterMemory
from simulators.camera.simulated_camera import SimulatedCamera

# Set by a program that wants one packet of the size to see whether it gets through.
_TEST_PACKET = 1 << 31
_MOST_XML_BYTES = 1 << 24
_KEPT_FRAMES = 4
# Between two frames of a camera that runs without triggers.
_FREE_RUN_S = 0.05
# Registers of the link, which a user set does not hold: who controls, heartbeat, streams, and where the XML stands.
_LINK = ((0x000, 0x100), (0x200, 0x240), (0x600, 0x604), (0x900, 0xA04), (0xB00, 0xB20), (0xD00, 0xD20))


class PlayedCamera(SimulatedCamera):
    """A simulated camera; a context manager that runs it.

    Parameters
    ----------
    serial, width, height, pixel_source, bits, lost_ratio, address, wait_s, elsewhere :
        As of `GigeCamera`.
    path : Path
        The description: XML, or the zip archive that holds it.
    complete : bool
        False plays a camera whose features do not suffice for a capture, so that a driver can refuse it.

    Raises
    ------
    ConfigError
        The file cannot be used; NodeError where a feature that a capture needs cannot be played.
    """

    def __init__(
        self,
        serial: str,
        width: int,
        height: int,
        pixel_source: PixelSource,
        path: Path,
        bits: int = 12,
        lost_ratio: float = 0.0,
        address: str = "127.0.0.1",
        wait_s: float = 60.0,
        elsewhere: bool = False,
        complete: bool = True,
    ) -> None:
        super().__init__(address, elsewhere)
        self.serial = serial
        self.bits = bits
        self.lost_ratio = lost_ratio
        #: Triggers that came while the camera exposed.
        self.ignored_triggers = 0
        #: When the last trigger came that was heeded, by the monotonic clock.
        self.triggered_s = 0.0
        self._sensor = (width, height)
        self._source = pixel_source
        self._path = path
        self._complete = complete
        self._wait_s = wait_s
        self._description = read_description(path)
        # Control answers in one thread, exposures run in another; both look at the registers.
        self._lock = threading.RLock()
        self._wake = threading.Condition(self._lock)
        self._channel = ControlChannel(self)
        self._worker: threading.Thread | None = None
        self._events: EventMessages | None = None
        self._was_on = self._plugged_in = self._acquiring = self._triggered = self._busy = False
        # Which start of the acquisition this is: an exposure of an earlier one is thrown away.
        self._run_number = 0
        self._frame_id = 0
        self._sent: deque[FramePackets] = deque(maxlen=_KEPT_FRAMES)
        self._prepare()

    def _prepare(self) -> None:
        root = self._description.root
        texts = {
            "DeviceVendorName": root.get("VendorName") or "unknown",
            "DeviceModelName": root.get("ModelName") or "unknown",
            "DeviceVersion": "simulated",
            "DeviceID": self.serial,
        }
        self._memory = RegisterMemory()
        self._nodes = NodeTree(root, self._memory, self._path)
        try:
            power_up(self._nodes, self._sensor, {**texts, "DeviceSerialNumber": self.serial})
            self._features = Features(self._nodes, self._sensor, complete=self._complete)
            self._default = self._memory.copy()
        except RecursionError as error:
            raise NodeError(f"{self._path}: its features refer to each other without an end") from error
        self._xml_at = self._free_address()
        self._texts = texts

    def _free_address(self) -> int:
        taken = []
        for name in self._nodes:
            if self._nodes.node(name).tag in REGISTERS:
                try:
                    taken.append(self._nodes.register(name))
                except NodeError:
                    continue
        tops = range(0xFF00_0000, 0, -_MOST_XML_BYTES)
        return next(at for at in tops if not any(register.overlaps(at, _MOST_XML_BYTES) for register in taken))

    # --- life --------------------------------------------------------------------------------------------

    def start(self) -> None:
        # After `vanish` it is as after being switched on.
        self._loopback.take(self._wait_s)
        self.address = self._loopback.address
        if self._was_on:
            self._prepare()
        self._plugged_in = self._was_on = True
        xml = (self._description.name, self._xml_at, len(self._description.served))
        boot(self._memory, self.address, self._texts, xml)
        self._events = EventMessages(self._bootstrap)
        try:
            self._channel.open(self.address)
        except OSError as error:
            self._loopback.release()
            raise CameraError(
                f"start a simulated camera at {self.address}", str(error), "Is it running already?"
            ) from error
        self._worker = threading.Thread(target=self._run, name=f"exposures of camera {self.address}", daemon=True)
        self._worker.start()

    def vanish(self) -> None:
        with self._wake:
            self._plugged_in = False
            self._begin(acquiring=False)
        self._channel.close()
        if self._events is not None:
            self._events.close()
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.join()

    def fire(self) -> None:
        """Start an exposure from outside, as a pulse on the trigger line does."""
        self._trigger(by_program=False)

    def leave(self, name: str, value: Number | str) -> None:
        """Set a feature as another program left it: a number, an entry, or 0 and 1 for a flag.

        Raises
        ------
        NodeError
            It cannot be set.
        """
        with self._lock:
            if isinstance(value, str):
                self._nodes.choose(name, value)
            else:
                self._nodes.set_value(name, value)
            self._features.follow()

    # --- what the control channel asks for ---------------------------------------------------------------

    def read(self, address: int, count: int) -> bytes:
        """Bytes of the registers, or of the description behind them."""
        start = address - self._xml_at
        if 0 <= start < _MOST_XML_BYTES:
            return self._description.served[start : start + count].ljust(count, b"\0")
        with self._lock:
            return self._memory.read(address, count)

    def write(self, address: int, data: bytes) -> None:
        """Write registers, and do what was commanded by it."""
        with self._wake:
            self._memory.write(address, data)
            if address == PACKET_SIZE and self._bootstrap(PACKET_SIZE) & _TEST_PACKET:
                self._send_test_packet()
            try:
                commands = self._features.heard(address, len(data))
                self._features.follow()
                if any(load in commands for load in LOADS):
                    self._memory.restore(self._default, but=_LINK)
                    self._features.follow()
                if TRIGGER in commands:
                    self._trigger(by_program=True)
            except (NodeError, ArithmeticError, ValueError) as error:
                # Registers hold whatever is written: no program may end the thread that answers.
                self._error = self._error or error
                return
            if START in commands or STOP in commands:
                self._begin(acquiring=START in commands)

    def resend(self, frame_id: int, first: int, last: int) -> None:
        """Send packets once more, while the frame is kept."""
        for frame in list(self._sent):
            if frame.frame_id == frame_id:
                send(frame, self._bootstrap, self.address, self.lost_ratio, range(first, last + 1))

    def released(self) -> None:
        """Without anybody who controls it a camera stops."""
        self._begin(acquiring=False)

    def _begin(self, *, acquiring: bool) -> None:
        """Start or stop: whatever was under way ends, and frames are numbered anew."""
        with self._wake:
            self._acquiring, self._triggered, self._frame_id = acquiring, False, 0
            self._run_number += 1
            self._features.show(exposing=False, armed=True)
            self._wake.notify_all()

    def _bootstrap(self, address: int) -> int:
        return int(struct.unpack(">I", self._memory.read(address, 4))[0])

    def _send_test_packet(self) -> None:
        size = self._bootstrap(PACKET_SIZE)
        self._memory.write(PACKET_SIZE, struct.pack(">I", size & ~_TEST_PACKET))
        host = socket.inet_ntoa(self._memory.read(HOST_ADDRESS, 4))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
            channel.bind((self.address, 0))
            channel.sendto(
                bytes(max(0, (size & 0xFFFF) - TRANSPORT_BYTES)), (host, self._bootstrap(HOST_PORT) & 0xFFFF)
            )

    # --- exposures ---------------------------------------------------------------------------------------

    def _trigger(self, *, by_program: bool) -> None:
        with self._wake:
            source = self._features.trigger_source()
            if not self._acquiring or source is None or by_program != (source == "Software"):
                return
            if self._busy or self._triggered:
                self.ignored_triggers += 1
                self._tell("missed", 0)
                return
            self._triggered, self.triggered_s = True, time.monotonic()
            # Before the command is answered: whoever asks then is told that it exposes.
            self._features.show(exposing=True, armed=False)
            self._wake.notify_all()

    def _tell(self, moment: Moment, frame_id: int) -> None:
        if self._events is not None:
            for number in self._features.events(moment):
                self._events.tell(self.address, number, frame_id, time.time_ns())

    def _run(self) -> None:
        while self._plugged_in:
            try:
                if self._wait_for_start():
                    self._expose()
            except BaseException as error:  # noqa: BLE001 - check() raises it where it is seen
                self._error = self._error or error
            finally:
                self._busy = False

    def _wait_for_start(self) -> bool:
        with self._wake:
            self._wake.wait_for(lambda: self._acquiring or not self._plugged_in)
            if self._acquiring and self._features.trigger_source() is None:
                self._wake.wait_for(lambda: not self._acquiring, _FREE_RUN_S)
                if self._acquiring:
                    self._triggered = True
            self._wake.wait_for(lambda: self._triggered or not self._acquiring, _FREE_RUN_S)
            if not (self._triggered and self._acquiring):
                return False
            self._triggered, self._busy = False, True
            self._frame_id = self._frame_id % 65535 + 1
            return True

    def _expose(self) -> None:
        with self._lock:
            run_number = self._run_number
            fmt = pixel_format_of(*self._features.pixel_format())
            self._features.show(exposing=True, armed=False)
            wait_s = delay_s(self._features)
            info = exposed(self._features, self._features.info(self._frame_id))
            self._wake.wait_for(lambda: self._run_number != run_number, wait_s)
            start_s, time_ns = time.monotonic(), time.time_ns()
            self._tell("started", info.frame_id)
        try:
            counts = counts_of(self._source, info, fmt, self.bits)
            with self._lock:
                counts = processed(self._features, info, counts, fmt.bits)
            data = fmt.encode(counts).tobytes()
            with self._wake:
                left_s = start_s + info.exposure_s - time.monotonic()
                self._wake.wait_for(lambda: self._run_number != run_number, max(0.0, left_s))
                if self._run_number != run_number:
                    return
                code, _ = self._features.pixel_format()
                chunks = self._features.time_chunk(time_ns)
        finally:
            with self._lock:
                self._busy = False
                if self._run_number == run_number:
                    self._features.show(exposing=False, armed=True)
                    self._tell("ended", info.frame_id)
        payload = data if chunks is None else with_chunks(data, chunks)
        frame = FramePackets(info.frame_id, time_ns, code & 0xFFFF_FFFF, info.region, payload, chunks is not None)
        self._sent.append(frame)
        send(frame, self._bootstrap, self.address, self.lost_ratio)
