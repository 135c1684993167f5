"""A real GigE Vision camera on loopback that shows our own pixels.

It is Aravis' fake camera: it speaks the control and the stream protocol over UDP, so a driver cannot tell that it
is simulated. Its pixels come from a Python function that is called at each exposure, in the camera's own thread.

One camera occupies one address. A second one at the same time needs a second loopback address, which root adds
with `ip addr add 127.0.0.2/8 dev lo`.
"""

from __future__ import annotations

import ctypes
import struct
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from drivers.aravis_library import load_aravis
from drivers.errors import CameraError
from drivers.pixel_formats import PixelFormat, pixel_format, pixel_format_of
from simulators.camera import gige_features as features
from simulators.camera.camera_memory import CameraMemory
from simulators.camera.event_messages import (
    CAPABILITY,
    EVENTS,
    EVENTS_SUPPORTED,
    NUMBER_OF_CHANNELS,
    EventMessages,
    Moment,
)
from simulators.camera.exposure import ExposureInfo, PixelSource, counts_of
from simulators.camera.frame_packets import FramePackets, send, with_chunks
from simulators.camera.node_map import node_map
from simulators.camera.simulated_camera import SimulatedCamera

_FillPattern = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)


class GigeCamera(SimulatedCamera):
    """A simulated camera; a context manager that runs it.

    Parameters
    ----------
    serial : str
        Serial number, under 16 characters.
    width, height : int
        Sensor size in pixels.
    pixel_source : callable
        Gets an `ExposureInfo` at the start of each exposure and returns counts, uint16 of shape (height, width) of
        that info. If it raises, no frame is sent and the error is raised when the context ends, or by `check()`.
    bits : int
        Real bits of the counts in the 16-bit format; more is an error of the pixel source.
    lost_ratio : float
        Part of the packets that are lost, 0 to 1; may be changed at any time.
    address : str
        Loopback address to occupy.
    description : str
        Name of a table in `node_maps/`, or "aravis" for Aravis' own description with older names (ExposureTimeAbs).
    wait_s : float
        How long to wait for the address if another simulated camera has it.
    elsewhere : bool
        Take another loopback address of this machine at once, if there is one that no camera has.
    arming_s : float
        Time after an exposure in which a trigger is ignored; None for that of the table.
    """

    def __init__(
        self,
        serial: str,
        width: int,
        height: int,
        pixel_source: PixelSource,
        bits: int = 12,
        lost_ratio: float = 0.0,
        address: str = "127.0.0.1",
        description: str = "loopback",
        wait_s: float = 60.0,
        arming_s: float | None = None,
        elsewhere: bool = False,
    ) -> None:
        super().__init__(address, elsewhere)
        self.serial = serial
        self._size = (width, height)
        self._source = pixel_source
        self.bits = bits
        self._lost_ratio = lost_ratio
        self._table = None if description == "aravis" else node_map(description)
        self._wait_s = wait_s
        self._arming_s = arming_s if arming_s is not None else self._table.arming_s if self._table else 0.0
        self._armed_at_s = 0.0
        #: Triggers that came before the camera was armed.
        self.ignored_triggers = 0
        #: Camera times that were sent behind the images.
        self.chunk_times_ns: list[int] = []
        #: So many frames to come are sent without that time.
        self.timeless_frames = 0
        # Holds frames of exposures that start from now on back, as a busy host or a full link does.
        self.delivery_delay_s = 0.0
        self._gone = threading.Event()
        self._camera: Any = None
        self._memory: CameraMemory | None = None
        self._events: EventMessages | None = None
        # First, because its message says what is missing.
        load_aravis()
        self._library = ctypes.CDLL("libaravis-0.8.so.0")
        self._library.arv_buffer_get_data.restype = ctypes.c_void_p
        self._library.arv_buffer_get_data.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
        self._library.arv_buffer_get_frame_id.restype = ctypes.c_uint64
        self._library.arv_buffer_get_frame_id.argtypes = [ctypes.c_void_p]
        self._library.arv_fake_camera_set_fill_pattern.argtypes = [ctypes.c_void_p, _FillPattern, ctypes.c_void_p]
        # ctypes frees the callback when the last reference goes; Aravis would then call into nothing.
        self._callback = _FillPattern(self._fill)

    # --- life --------------------------------------------------------------------------------------------

    def start(self) -> None:
        aravis, _ = load_aravis()
        self._loopback.take(self._wait_s)
        self.address = self._loopback.address
        with tempfile.TemporaryDirectory() as folder:
            path = None
            if self._table is not None:
                path = Path(folder) / "camera.xml"
                path.write_text(features.description(self._table, *self._size))
            camera = aravis.GvFakeCamera.new_full(self.address, self.serial, None if path is None else str(path))
        # It also says that it runs where it could not bind its port, which is why the address was taken first.
        if not camera.is_running():
            self._loopback.release()
            raise CameraError(
                f"start a simulated camera at {self.address}",
                "no network interface has that address",
                f"Add it: ip addr add {self.address}/8 dev lo",
            )
        self._gone.clear()
        self._camera, self._memory = camera, CameraMemory(camera.get_fake_camera())
        self._memory.power_up(*self._size, self._table)
        self._events = EventMessages(self._memory.read)
        if self._table is not None and self._table.events:
            self._memory.write(NUMBER_OF_CHANNELS, 1)
            self._memory.write(CAPABILITY, self._memory.read(CAPABILITY) | EVENTS_SUPPORTED)
        # hash() of a GObject wrapper is the object's address.
        self._library.arv_fake_camera_set_fill_pattern(self._memory.address, self._callback, None)
        self.lost_ratio = self._lost_ratio

    def vanish(self) -> None:
        if self._camera is None or self._memory is None:
            return
        self._gone.set()
        # No frame must leave with Aravis' own pattern, and no Python may run while its thread is joined.
        self._camera.set_property("gvsp-lost-ratio", 1.0)
        self._library.arv_fake_camera_set_fill_pattern(self._memory.address, _FillPattern(), None)
        self._camera = self._memory = None
        if self._events is not None:
            self._events.close()

    @property
    def lost_ratio(self) -> float:
        """Part of the packets that are lost."""
        return self._lost_ratio

    @lost_ratio.setter
    def lost_ratio(self, ratio: float) -> None:
        self._lost_ratio = ratio
        if self._camera is not None:
            self._camera.set_property("gvsp-lost-ratio", ratio)

    def fire(self) -> None:
        """Start an exposure from outside, as a pulse on the trigger line does."""
        # Aravis knows software triggers alone, so the source changes behind the driver's back.
        self._live_memory().write(features.TRIGGER_SOURCE, 1)
        self._live_memory().write(features.SOFTWARE_TRIGGER, 1)

    def _live_memory(self) -> CameraMemory:
        if self._memory is None:
            raise CameraError(f"look into the camera at {self.address}", "it is not running", "Start it first")
        return self._memory

    def write_register(self, address: int, value: int) -> None:
        """Write a 32-bit register, behind the back of whoever controls the camera."""
        self._live_memory().write(address, value)

    def register(self, address: int) -> int:
        """Read a 32-bit register, as a look into the camera from behind."""
        return self._live_memory().read(address)

    # --- the exposure, in the camera's own thread --------------------------------------------------------

    def _fill(self, buffer: int, _: int, exposure_us: int, gain_raw: int, code: int) -> None:
        start_s, delay_s = time.monotonic(), self.delivery_delay_s
        camera = self._camera
        if start_s < self._armed_at_s and camera is not None:
            self.ignored_triggers += 1
            self._tell("missed", 0)
            camera.set_property("gvsp-lost-ratio", 1.0)
            return
        chunked: FramePackets | None = None
        try:
            info = self._info(buffer, exposure_us, gain_raw)
            self._tell("started", info.frame_id)
            fmt = self._format(code)
            data = fmt.encode(counts_of(self._source, info, fmt, self.bits))
            if self._sends_chunks():
                time_ns = time.time_ns()
                times = {features.TIMESTAMP_CHUNK: struct.pack(">Q", time_ns)} if self.timeless_frames <= 0 else {}
                payload = with_chunks(data.tobytes(), times)
                chunked = FramePackets(info.frame_id, time_ns, code & 0xFFFFFFFF, info.region, payload, True)
                self.timeless_frames -= 1
            else:
                ctypes.memmove(self._library.arv_buffer_get_data(buffer, None), data.ctypes.data, data.nbytes)
            if camera is not None and not self._gone.is_set():
                camera.set_property("gvsp-lost-ratio", 1.0 if chunked else self._lost_ratio)
        except BaseException as error:  # noqa: BLE001 - nothing may pass into C; check() raises it where it is seen
            self._error = self._error or error
            if camera is not None:
                camera.set_property("gvsp-lost-ratio", 1.0)
        del camera
        self._arm_after(start_s + exposure_us * 1e-6)
        # The frame is sent when this returns, and no frame leaves a camera before its exposure has ended.
        # Real time: the same thread answers commands, and Aravis gives up a camera that is silent for three seconds.
        self._gone.wait(max(0.0, start_s + exposure_us * 1e-6 - time.monotonic()))
        if not self._gone.is_set():
            self._tell("ended", int(self._library.arv_buffer_get_frame_id(buffer)))
        self._gone.wait(delay_s)
        if chunked is not None and self._memory is not None and not self._gone.is_set():
            self.chunk_times_ns.append(chunked.time_ns)
            send(chunked, self._memory.read, self.address, self._lost_ratio)

    def _tell(self, moment: Moment, frame_id: int) -> None:
        """Tell the events of a moment that a host has asked for."""
        memory, events = self._memory, self._events
        if self._table is None or memory is None or events is None:
            return
        for k, (name, number) in enumerate(self._table.events.items()):
            if name in EVENTS[moment] and memory.read(features.EVENT_NOTIFICATION + 4 * k):
                events.tell(self.address, number, frame_id, time.time_ns())

    def _sends_chunks(self) -> bool:
        offers = self._table is not None and self._table.chunk_timestamp
        return offers and bool(self._live_memory().read(features.CHUNK_MODE))

    def _arm_after(self, exposed_s: float) -> None:
        if self._arming_s <= 0 or self._gone.is_set():
            return
        self._armed_at_s = exposed_s + self._arming_s
        self._live_memory().write(features.TRIGGER_ARMED, 0)
        # A little late, so that what the register says holds.
        timer = threading.Timer(max(0.0, self._armed_at_s - time.monotonic()) + 2e-3, self._arm)
        timer.daemon = True
        timer.start()

    def _arm(self) -> None:
        if self._memory is not None:
            self._memory.write(features.TRIGGER_ARMED, 1)

    def _info(self, buffer: int, exposure_us: int, gain_raw: int) -> ExposureInfo:
        memory, table = self._live_memory(), self._table
        info = ExposureInfo(
            exposure_s=exposure_us * 1e-6,
            gain_db=float(gain_raw),
            black_level=0.0,
            frame_id=int(self._library.arv_buffer_get_frame_id(buffer)),
            width=memory.read(features.WIDTH),
            height=memory.read(features.HEIGHT),
            offset_x=memory.read(features.OFFSET_X),
            offset_y=memory.read(features.OFFSET_Y),
            binning=memory.read(features.BINNING_X),
        )
        if table is None:
            return info
        return replace(
            info,
            gain_db=memory.number(table.gain),
            black_level=memory.number(table.black_level),
            decimation=memory.read(features.DECIMATION_X),
            reverse_x=bool(memory.read(features.REVERSE_X)),
            reverse_y=bool(memory.read(features.REVERSE_Y)),
        )

    def _format(self, code: int) -> PixelFormat:
        if self._table is None:
            return pixel_format(code)
        names = {value: name for name, value in self._table.codes().items()}
        return pixel_format_of(code, names[code & 0xFFFFFFFF])
