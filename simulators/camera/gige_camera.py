"""A simulated GigE Vision camera on loopback: it serves a GenICam description and does what its features say.

Registers are memory; a few features act, by their standard (SFNC) names: region, pixel format, exposure, gain,
triggers, acquisition, status, time stamps behind the image. A program can set and read back all others.
Its pixels come from a Python function that is called at each exposure, in a thread of the camera.

One camera occupies one address. A second one at the same time needs a second loopback address, which root adds
with `ip addr add 127.0.0.2/8 dev lo`.
"""

import functools
import struct
import threading
import time
from collections import deque
from pathlib import Path
from typing import Self
from xml.etree.ElementTree import Element

from drivers.errors import CameraError
from drivers.pixel_formats import pixel_format_of
from simulators.camera.bootstrap import MOST_XML_BYTES, boot, free_address
from simulators.camera.control_channel import ControlChannel
from simulators.camera.exposure import PixelSource, counts_of
from simulators.camera.frame_packets import PACKET_SIZE, FramePackets, send, send_test_packet, with_chunks
from simulators.camera.genicam.features import LOADS, START, STOP, TRIGGER, FeatureValues
from simulators.camera.genicam.formula import Number
from simulators.camera.genicam.node_tree import NodeError, NodeTree
from simulators.camera.genicam.power_up import power_up
from simulators.camera.genicam.register import RegisterMemory
from simulators.camera.gige_features import describe
from simulators.camera.image_settings import delay_s, exposed, processed
from simulators.camera.loopback_address import LoopbackAddress

# Set by a program that wants one packet of the size to see whether it gets through.
_TEST_PACKET = 1 << 31
_KEPT_FRAMES = 4
# Between two frames of a camera that runs without triggers.
_FREE_RUN_S = 0.05
# Registers of the link, which a user set does not hold: control, heartbeat, streams, and location of the XML.
_LINK = ((0x000, 0x100), (0x200, 0x240), (0x600, 0x604), (0x900, 0xA04), (0xB00, 0xB20), (0xD00, 0xD20))


@functools.lru_cache(maxsize=16)
def _powered_up(
    root: Element, source: Path, sensor: tuple[int, int], serial: str
) -> tuple[RegisterMemory, NodeTree, dict[str, str]]:
    """Memory, features and identity of a camera that is switched on: tests switch a few on some hundred times."""
    texts = {
        "DeviceVendorName": root.get("VendorName") or "unknown",
        "DeviceModelName": root.get("ModelName") or "unknown",
        "DeviceVersion": "simulated",
        "DeviceID": serial,
    }
    memory = RegisterMemory()
    nodes = NodeTree(root, memory, source)
    power_up(nodes, sensor, {**texts, "DeviceSerialNumber": serial})
    return memory, nodes, texts


class GigeCamera:
    """A simulated camera; a context manager that runs it and raises at its end what went wrong in an exposure.

    Parameters
    ----------
    serial : serial number, under 16 characters.
    width, height : sensor size in pixels.
    pixel_source : gets an `ExposureInfo` at the start of each exposure and returns counts, uint16 of shape (height,
        width) of that info. If it raises, no frame is sent and the error is raised when the context ends, or by
        `check()`.
    description : name of a table in `node_maps/`, or a file: a table (.yaml), or a GenICam description (.xml, .zip).
    bits : real bits of the counts in the 16-bit format; more is an error of the pixel source.
    lost_ratio : part of the packets that are lost, 0 to 1; may be changed at any time.
    address : loopback address to occupy.
    wait_s : how long to wait for the address if another simulated camera has it.
    arming_s : time after an exposure in which a trigger is ignored; None for that of the table.
    elsewhere : take another loopback address of this machine at once, if there is one that no camera has.
    complete : False plays a camera whose features do not suffice for a capture, so that a driver can refuse it.

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
        *,
        description: str | Path = "loopback",
        bits: int = 12,
        lost_ratio: float = 0.0,
        address: str = "127.0.0.1",
        wait_s: float = 60.0,
        arming_s: float | None = None,
        elsewhere: bool = False,
        complete: bool = True,
    ) -> None:
        self.address = address
        self.serial = serial
        self.bits = bits
        self.lost_ratio = lost_ratio
        #: Triggers that came while the camera exposed, or before it was armed again.
        self.ignored_triggers = 0
        #: When the last trigger came that was heeded, by the monotonic clock.
        self.triggered_s = 0.0
        #: Number of the first frame after a start.
        self.first_frame_id = 1
        #: Holds frames of exposures that start from now on back, as a busy host or a full link does.
        self.delivery_delay_s = 0.0
        #: So many frames to come are sent without the chunk that has their time.
        self.timeless_frames = 0
        #: The last frames, which can be sent again.
        self.sent: deque[FramePackets] = deque(maxlen=_KEPT_FRAMES)
        self._loopback = LoopbackAddress(address, elsewhere)
        self._error: BaseException | None = None
        self._sensor = (width, height)
        self._source = pixel_source
        self._complete = complete
        self._wait_s = wait_s
        self._description = describe(str(description), self._sensor)
        self._arming_s = self._description.arming_s if arming_s is None else arming_s
        self._armed_at_s = 0.0
        # Control answers in one thread, exposures run in another; both look at the registers.
        self._lock = threading.RLock()
        self._wake = threading.Condition(self._lock)
        self._channel = ControlChannel(self)
        self._worker: threading.Thread | None = None
        self._was_on = self._plugged_in = self._acquiring = self._triggered = self._busy = False
        # Which start of the acquisition this is: an exposure of an earlier one is thrown away.
        self._run_number = 0
        self._frame_id = 0
        self._prepare()

    def _prepare(self) -> None:
        description = self._description
        try:
            memory, nodes, texts = _powered_up(description.root, description.source, self._sensor, self.serial)
            #: Its registers, the features that name them, and what these make the camera do.
            self.memory = memory.copy()
            self.nodes = nodes.copy(self.memory)
            self.features = FeatureValues(self.nodes, self._sensor, complete=self._complete)
            for name, value in description.at_power_up.items():
                if name in self.nodes:
                    self.leave(name, value)
            #: Registers that the user set `Default` brings back.
            self.default = self.memory.copy()
        except RecursionError as error:
            raise NodeError(f"{description.source}: its features refer to each other without an end") from error
        self._xml_at = free_address(self.nodes)
        self._texts = texts

    # --- life --------------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self.stop()
        if error is None:
            self.check()

    def start(self) -> None:
        """Start the camera; after `vanish` it is as after being switched on.

        Raises CameraError: the address is taken or does not exist.
        """
        self._loopback.take(self._wait_s)
        self.address = self._loopback.address
        if self._was_on:
            self._prepare()
        self._plugged_in = self._was_on = True
        xml = (self._description.name, self._xml_at, len(self._description.served))
        boot(self.memory, self.address, self._texts, xml)
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
        """End the camera at once, as if its plug was pulled; `start` plugs it in again.

        The address stays ours until `stop`: a driver that does not know yet must not talk to another camera there.
        """
        with self._wake:
            self._plugged_in = False
            self._begin(acquiring=False)
        self._channel.close()
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.join()

    def stop(self) -> None:
        """End the camera and let the next one have its address."""
        self.vanish()
        self._loopback.release()

    def check(self) -> None:
        """Raise what went wrong in an exposure, if anything did."""
        error, self._error = self._error, None
        if error is not None:
            raise error

    def fire(self, *, unasked: bool = False) -> None:
        """Start an exposure from outside, as a pulse on the trigger line does; `unasked`: with any trigger source."""
        self._trigger(by_program=False, unasked=unasked)

    def value(self, name: str) -> Number:
        """Value of a feature or a register, by its name in the description. Raises NodeError."""
        with self._lock:
            return self.nodes.value(name)

    def leave(self, name: str, value: Number | str) -> None:
        """Set a feature as another program left it: a number, an entry, or 0 and 1 for a flag.

        Raises NodeError: it cannot be set.
        """
        with self._lock:
            if isinstance(value, str):
                self.nodes.choose(name, value)
            else:
                self.nodes.set_value(name, value)
            self.features.follow()

    # --- what the control channel asks for ---------------------------------------------------------------

    def read(self, address: int, count: int) -> bytes:
        """Bytes of the registers, or of the description behind them."""
        start = address - self._xml_at
        if 0 <= start < MOST_XML_BYTES:
            return self._description.served[start : start + count].ljust(count, b"\0")
        with self._lock:
            return self.memory.read(address, count)

    def write(self, address: int, data: bytes) -> None:
        """Write registers, and obey the commands among them."""
        with self._wake:
            self.memory.write(address, data)
            if address == PACKET_SIZE and self._bootstrap(PACKET_SIZE) & _TEST_PACKET:
                self.memory.write(PACKET_SIZE, struct.pack(">I", self._bootstrap(PACKET_SIZE) & ~_TEST_PACKET))
                send_test_packet(self._bootstrap, self.address)
            try:
                commands = self.features.heard(address, len(data))
                self.features.follow()
                if any(load in commands for load in LOADS):
                    self.memory.restore(self.default, but=_LINK)
                    self.features.follow()
                if TRIGGER in commands:
                    self._trigger(by_program=True)
            except (NodeError, ArithmeticError, ValueError) as error:
                # Registers take every value: no program may end the thread that answers.
                self._error = self._error or error
                return
            if START in commands or STOP in commands:
                self._begin(acquiring=START in commands)

    def resend(self, frame_id: int, first: int, last: int) -> None:
        """Send packets once more, while the frame is kept."""
        for frame in list(self.sent):
            if frame.frame_id == frame_id:
                send(frame, self._bootstrap, self.address, self.lost_ratio, numbers=range(first, last + 1))

    def released(self) -> None:
        """Stop the camera when no program controls it."""
        self._begin(acquiring=False)

    def _begin(self, *, acquiring: bool) -> None:
        """Start or stop: a running acquisition ends, and frames are numbered anew."""
        with self._wake:
            self._acquiring, self._triggered, self._frame_id = acquiring, False, self.first_frame_id - 1
            self._run_number += 1
            self._armed_at_s = 0.0
            self.features.show(exposing=False, armed=True)
            self._wake.notify_all()

    def _bootstrap(self, address: int) -> int:
        return int(struct.unpack(">I", self.memory.read(address, 4))[0])

    # --- exposures ---------------------------------------------------------------------------------------

    def _trigger(self, *, by_program: bool, unasked: bool = False) -> None:
        with self._wake:
            source = self.features.trigger_source()
            is_source = source is not None and by_program == (source == "Software")
            if not self._acquiring or not (is_source or unasked):
                return
            if self._busy or self._triggered or time.monotonic() < self._armed_at_s:
                self.ignored_triggers += 1
                return
            self._triggered, self.triggered_s = True, time.monotonic()
            # Before the command is answered: the status then is "exposing".
            self.features.show(exposing=True, armed=False)
            self._wake.notify_all()

    def _run(self) -> None:
        while self._plugged_in:
            try:
                run_number = self._wait_for_start()
                if run_number is not None:
                    self._expose(run_number)
            except BaseException as error:  # noqa: BLE001 - check() raises it where it is seen
                self._error = self._error or error

    def _expose(self, run_number: int) -> None:
        frame, hold_back_s = None, self.delivery_delay_s
        try:
            frame = self._frame(run_number)
        except BaseException as error:  # noqa: BLE001 - check() raises it, also where the exposure is seen to end
            self._error = self._error or error
        with self._lock:
            self._busy = False
            if self._run_number == run_number:
                self._armed_at_s = time.monotonic() + self._arming_s
                self.features.show(exposing=False, armed=not self._arming_s)
        if frame is not None:
            time.sleep(hold_back_s)
            self.sent.append(frame)
            send(frame, self._bootstrap, self.address, self.lost_ratio)
        if self._arming_s:
            self._arm(run_number)

    def _arm(self, run_number: int) -> None:
        """Show that a trigger is heeded again, once it is."""
        with self._wake:
            self._wake.wait_for(lambda: self._run_number != run_number, max(0.0, self._armed_at_s - time.monotonic()))
            if self._run_number == run_number:
                self.features.show(exposing=False, armed=True)

    def _wait_for_start(self) -> int | None:
        """Which start of the acquisition the exposure belongs to that begins now; None where none does."""
        with self._wake:
            self._wake.wait_for(lambda: self._acquiring or not self._plugged_in)
            if self._acquiring and self.features.trigger_source() is None:
                self._wake.wait_for(lambda: not self._acquiring, _FREE_RUN_S)
                if self._acquiring:
                    self._triggered = True
            self._wake.wait_for(lambda: self._triggered or not self._acquiring, _FREE_RUN_S)
            if not (self._triggered and self._acquiring):
                return None
            self._triggered, self._busy = False, True
            self._frame_id = self._frame_id % 65535 + 1
            return self._run_number

    def _frame(self, run_number: int) -> FramePackets | None:
        """The frame of an exposure; None where the acquisition ended before it."""
        with self._wake:
            fmt = pixel_format_of(*self.features.pixel_format())
            self.features.show(exposing=True, armed=False)
            info = exposed(self.features, self.features.info(self._frame_id))
            self._wake.wait_for(lambda: self._run_number != run_number, delay_s(self.features))
            start_s, time_ns = time.monotonic(), time.time_ns()
        counts = counts_of(self._source, info, fmt, self.bits)
        with self._lock:
            counts = processed(self.features, info, counts, fmt.bits)
        payload = fmt.encode(counts).tobytes()
        with self._wake:
            remaining_s = start_s + info.exposure_s - time.monotonic()
            self._wake.wait_for(lambda: self._run_number != run_number, max(0.0, remaining_s))
            if self._run_number != run_number:
                return None
            code, _ = self.features.pixel_format()
            chunks = self.features.time_chunk(time_ns)
        if chunks is not None:
            if self.timeless_frames > 0:
                self.timeless_frames, chunks = self.timeless_frames - 1, {}
            payload = with_chunks(payload, chunks)
        return FramePackets(info.frame_id, time_ns, code & 0xFFFF_FFFF, info.region, payload, chunks is not None)
