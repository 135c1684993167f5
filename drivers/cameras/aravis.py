"""Any GenICam camera through Aravis: GigE Vision and USB3 Vision.

Names of features are those of the GenICam SFNC with the older ones as second choice (`drivers/genicam.py`). Tried on
Aravis 0.8.26 and its loopback GigE Vision camera; not yet on a camera of a maker.
"""

from __future__ import annotations

import contextlib
import logging
import time
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from drivers import genicam
from drivers.aravis_library import interface_of, load_aravis, open_camera
from drivers.aravis_stream import Arrival, FrameStream
from drivers.camera import Camera, CameraIdentity, CameraSettings, Frame, StreamStatistics
from drivers.errors import CameraError, FrameLost, SettingRefused, UnknownPixelFormat
from drivers.genicam import Features
from drivers.pixel_formats import PixelFormat, pixel_format

log = logging.getLogger(__name__)

# Ctrl-C is noticed when a C call returns, so no call waits longer than this.
_SLICE_S = 0.1
# The slowest link that still makes sense for a camera, 100 Mbit/s, and a margin on top.
_SLOWEST_BYTES_S = 10e6
_TRANSFER_MARGIN_S = 1.0
# Fits every Ethernet; jumbo frames have to be asked for, because a switch in between may drop them.
_DEFAULT_PACKET_BYTES = 1500
# Differences on read-back that are rounding on cameras that state no step: a sensor row, a tenth of a decibel, a count.
_EXPOSURE_FLOOR_US = 20.0
_GAIN_FLOOR_DB = 0.1
_BLACK_LEVEL_FLOOR = 1.0
# What makes counts non-linear in light or changes between frames.
_SWITCHED_OFF = ("ExposureAuto", "GainAuto", "BlackLevelAuto", "GammaEnable", "LUTEnable", "ChunkModeActive")


class Config(BaseModel):
    """A camera in the rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["aravis"] = "aravis"
    device: str | None = Field(default=None, description="id, serial number or IP address; none: the only camera")
    interface: str | None = Field(default=None, description="network interface that must lead to it, e.g. enp3s0")
    packet_size: int | None = Field(default=None, ge=576, le=65535, description="bytes, with headers")
    resend: bool = Field(default=True, description="ask for lost packets again, where the camera can")
    retakes: int = Field(default=3, ge=0, description="how often a lost frame is taken again")
    buffers: int = Field(default=4, ge=2, le=64)
    bits: int | None = Field(default=None, ge=8, le=16, description="real bits, where the format has room for more")
    shift: int = Field(default=0, ge=0, le=8, description="empty low bits, where the camera left-aligns")
    gain_raw_per_db: float | None = Field(default=None, gt=0, description="for cameras that only have GainRaw")
    trigger_line: str = Field(default="Line0", description="input of the hardware trigger")
    trigger_edge: Literal["RisingEdge", "FallingEdge"] = "RisingEdge"
    trigger_timeout_s: float = Field(default=10.0, gt=0, description="longest wait for a hardware trigger")
    trigger_latency_s: float = Field(default=0.002, ge=0, description="added to the exposure before the bench moves")


def open(name: str, config: Config) -> AravisCamera:
    """Open the camera and take control of it; nothing is set and nothing is exposed.

    Raises
    ------
    CameraNotFound, CameraBusy, CameraError
        Not there (what is there is listed), controlled by another program, or Aravis is not installed.
    """
    aravis, glib_error = load_aravis()
    return AravisCamera(name, config, aravis, glib_error, open_camera(name, config.device, aravis, glib_error))


class AravisCamera(Camera):
    """A camera opened by `open`."""

    def __init__(self, name: str, config: Config, aravis: Any, glib_error: type[Exception], camera: Any) -> None:
        super().__init__(name, config.retakes)
        self._config = config
        self._aravis = aravis
        self._glib_error = glib_error
        self._camera = camera
        self._features = Features(name, aravis, glib_error, camera)
        self._is_gige = bool(camera.is_gv_device())
        self._stream: FrameStream | None = None
        self._counted: dict[str, int] = {}
        self._stale = 0
        self._asked_structure: tuple[object, ...] | None = None
        self._format: PixelFormat | None = None
        self._size = (0, 0)
        self._exposure_s = 0.0
        self._hardware = False
        self._status_feature = False
        # Exposure under way: sent at these host times, not collected yet.
        self._outstanding = False
        self._sent_unix_s = 0.0
        self._sent_s = 0.0
        self._last_id: int | None = None
        self._interface = self._find_interface()

    # --- identity ----------------------------------------------------------------------------------------

    @property
    def bits(self) -> int:
        """Real bits of a pixel: those of the format, or `bits` of the rig file for a wider container."""
        fmt = self._pixel_format()
        return min(self._config.bits or fmt.bits - self._config.shift, fmt.bits)

    def describe(self) -> CameraIdentity:
        """Which camera this is and how it is connected."""
        features, fmt = self._features, self._pixel_format()
        with features.asking("describe itself"):
            name, mtu = self._interface or ("", None)
            address = ""
            if self._is_gige:
                address = self._camera.get_device().get_device_address().get_address().to_string()
            return CameraIdentity(
                kind=self._config.kind,
                vendor=self._camera.get_vendor_name() or "",
                model=self._camera.get_model_name() or "",
                serial_number=features.text(genicam.SERIAL_NUMBER),
                firmware=features.text(genicam.FIRMWARE),
                address=address,
                interface=name,
                interface_mtu=mtu,
                packet_size=int(self._camera.gv_get_packet_size()) if self._is_gige else None,
                sensor_width=int(features.number(genicam.SENSOR_WIDTH) or 0),
                sensor_height=int(features.number(genicam.SENSOR_HEIGHT) or 0),
                pixel_format=fmt.name,
                pixel_format_code=fmt.code,
                bits=self.bits,
                shift=self._config.shift,
                polarized=fmt.polarized,
                library=f"Aravis {self._aravis._version}",
            )

    def temperature_c(self) -> float | None:
        """Temperature of the camera in degrees Celsius; None where it has no sensor."""
        return self._features.number(genicam.TEMPERATURE_C)

    def _pixel_format(self) -> PixelFormat:
        if self._format is None:
            with self._features.asking("read PixelFormat"):
                return pixel_format(int(self._camera.get_pixel_format()))
        return self._format

    def _find_interface(self) -> tuple[str, int] | None:
        if not self._is_gige:
            return None
        address = self._camera.get_device().get_interface_address().get_address().to_string()
        found = interface_of(address)
        wanted = self._config.interface
        if wanted is not None and (found is None or found[0] != wanted):
            raise CameraError(
                f"open camera {self.name} over {wanted}",
                f"it is reached over {found[0] if found else address}",
                "Plug it into the interface that the rig file names, or change `interface` there",
            )
        return found

    # --- settings ----------------------------------------------------------------------------------------

    def _do_configure(self, settings: CameraSettings) -> CameraSettings:
        self._discard_outstanding()
        structure = (
            settings.pixel_format,
            (settings.width, settings.height, settings.offset_x, settings.offset_y),
            settings.binning,
            settings.packet_size,
            settings.trigger,
        )
        if self._stream is None or structure != self._asked_structure:
            self._stop()
            self._asked_structure = None
            self._set_structure(settings)
            self._set_light(settings)
            self._start()
            self._asked_structure = structure
        else:
            self._drain()
            self._set_light(settings)
        return self._read_back(settings.frame_average)

    def _set_structure(self, settings: CameraSettings) -> None:
        features, camera = self._features, self._camera
        for name in _SWITCHED_OFF:
            features.switch_off(name)
        if features.find(("GammaEnable",)) is None and features.find(("Gamma",)) is not None:
            features.set_number(("Gamma",), 1.0, floor=1e-3)
        if settings.pixel_format is not None:
            self._format = pixel_format(settings.pixel_format)
            features.set_choice("PixelFormat", settings.pixel_format)
        if settings.binning is not None and (settings.binning != 1 or features.find(("BinningHorizontal",))):
            features.set_number(("BinningHorizontal",), settings.binning)
            features.set_number(("BinningVertical",), settings.binning)
        self._set_region(settings)
        if self._is_gige:
            self._set_packet_size(settings.packet_size or self._config.packet_size)
        elif settings.packet_size is not None:
            raise self._refused(f"packet_size {settings.packet_size}", "this camera is not on Ethernet")
        self._set_trigger(settings.trigger)
        with features.asking("read PixelFormat"):
            self._format = pixel_format(int(camera.get_pixel_format()))
        if self._config.bits is not None and self._config.bits > self._format.bits - self._config.shift:
            raise self._refused(
                f"bits {self._config.bits} and shift {self._config.shift} in the rig file",
                f"{self._format.name} holds {self._format.bits} bits",
            )

    def _set_region(self, settings: CameraSettings) -> None:
        # Offsets first to zero: they limit the size. Then the size, which limits the offsets.
        for offset, size, start, length in (
            ("OffsetX", "Width", settings.offset_x, settings.width),
            ("OffsetY", "Height", settings.offset_y, settings.height),
        ):
            if self._features.find((offset,)) is not None:
                self._features.set_number((offset,), 0)
            if length is None:
                with self._features.asking(f"read the limits of {size}"):
                    length = self._camera.get_integer_bounds(size)[1] - (start or 0)
            self._features.set_number((size,), length)
            if start:
                self._features.set_number((offset,), start)

    def _set_packet_size(self, packet_size: int | None) -> None:
        mtu = None if self._interface is None else self._interface[1]
        if packet_size is None:
            packet_size = min(_DEFAULT_PACKET_BYTES, mtu or _DEFAULT_PACKET_BYTES)
        if mtu is not None and packet_size > mtu:
            raise self._refused(
                f"packet_size {packet_size}",
                f"interface {self._interface[0]} has an MTU of {mtu}",  # type: ignore[index]
            )
        with self._features.asking(f"set packet size to {packet_size}"):
            self._camera.gv_set_packet_size_adjustment(self._aravis.GvPacketSizeAdjustment.NEVER)
            self._camera.gv_set_packet_size(packet_size)
            back = int(self._camera.gv_get_packet_size())
        if back != packet_size:
            raise self._refused(f"packet_size {packet_size}", f"it reads back {back}")

    def _set_trigger(self, trigger: Literal["software", "hardware"] | None) -> None:
        features = self._features
        self._hardware = trigger == "hardware"
        with features.asking("set AcquisitionMode to Continuous"):
            self._camera.set_acquisition_mode(self._aravis.AcquisitionMode.CONTINUOUS)
            # Every trigger off first: one left on by another program would hold frames back.
            self._camera.clear_triggers()
        if features.find(("ExposureMode",)) is not None:
            features.set_choice("ExposureMode", "Timed")
        if features.find(("TriggerSelector",)) is not None:
            features.set_choice("TriggerSelector", "FrameStart")
        features.set_choice("TriggerSource", self._config.trigger_line if self._hardware else "Software")
        if self._hardware and features.find(("TriggerActivation",)) is not None:
            features.set_choice("TriggerActivation", self._config.trigger_edge)
        features.set_choice("TriggerMode", "On")
        self._status_feature = (
            features.find(("AcquisitionStatusSelector",)) is not None
            and features.find(("AcquisitionStatus",)) is not None
        )
        if self._status_feature:
            try:
                features.set_choice("AcquisitionStatusSelector", "ExposureActive")
            except SettingRefused:
                self._status_feature = False

    def _set_light(self, settings: CameraSettings) -> None:
        """Exposure, gain and black level: no exposure is under way when this is called."""
        features = self._features
        if settings.exposure_s is not None:
            features.set_number(genicam.EXPOSURE_US, settings.exposure_s * 1e6, floor=_EXPOSURE_FLOOR_US)
        if settings.gain_db is not None:
            per_db = self._config.gain_raw_per_db
            if features.find(genicam.GAIN_DB) is not None:
                features.set_number(genicam.GAIN_DB, settings.gain_db, floor=_GAIN_FLOOR_DB)
            elif per_db is not None:
                features.set_number(genicam.GAIN_RAW, settings.gain_db * per_db)
            else:
                raise self._refused(
                    f"gain_db {settings.gain_db:g}",
                    "this camera has no Gain in decibels; with GainRaw, `gain_raw_per_db` is needed in the rig file",
                )
        if settings.black_level is not None:
            features.set_number(genicam.BLACK_LEVEL, settings.black_level, floor=_BLACK_LEVEL_FLOOR)

    def _read_back(self, frame_average: int | None) -> CameraSettings:
        features, camera = self._features, self._camera
        exposure_us = features.number(genicam.EXPOSURE_US)
        gain_db = features.number(genicam.GAIN_DB)
        raw = features.number(genicam.GAIN_RAW)
        if gain_db is None and raw is not None and self._config.gain_raw_per_db is not None:
            gain_db = raw / self._config.gain_raw_per_db
        self._exposure_s = (exposure_us or 0.0) * 1e-6
        binning = features.number(("BinningHorizontal",))
        with features.asking("read the region"):
            left, top, width, height = camera.get_region()
            packet_size = int(camera.gv_get_packet_size()) if self._is_gige else None
        self._size = (int(width), int(height))
        return CameraSettings(
            exposure_s=self._exposure_s or None,
            gain_db=gain_db,
            black_level=features.number(genicam.BLACK_LEVEL),
            pixel_format=self._pixel_format().name,
            width=int(width),
            height=int(height),
            offset_x=int(left),
            offset_y=int(top),
            binning=None if binning is None else int(binning),
            packet_size=packet_size,
            frame_average=frame_average or 1,
            trigger="hardware" if self._hardware else "software",
        )

    def _refused(self, what: str, came_back: str) -> SettingRefused:
        return SettingRefused(
            f"camera {self.name}, {what}", came_back, "Change the setting in the plan or the rig file"
        )

    # --- stream ------------------------------------------------------------------------------------------

    def _start(self) -> None:
        with self._features.asking("start the stream"):
            payload = int(self._camera.get_payload())
            self._stream = FrameStream(
                self._aravis, self._camera, payload, self._config.buffers, resend=self._config.resend
            )
            self._camera.start_acquisition()
        self._last_id = None

    def _stop(self) -> None:
        if self._stream is None:
            return
        with self._features.asking("stop the stream"):
            self._camera.stop_acquisition()
        self._close_stream()

    def _close_stream(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            for name, count in stream.counters().items():
                self._counted[name] = self._counted.get(name, 0) + count
            stream.close()

    def _restart(self) -> None:
        """After a frame that never came: stop, drain and start, so that it cannot come later."""
        self._outstanding = False
        with self._features.asking("restart the acquisition"):
            self._camera.stop_acquisition()
            self._drain()
            self._camera.start_acquisition()
        self._last_id = None

    def _live_stream(self) -> FrameStream:
        if self._stream is None:
            raise CameraError(f"camera {self.name}", "the stream is not running", "Call configure() again")
        return self._stream

    def _drain(self) -> None:
        """Throw away every frame that waits: it belongs to no exposure that is still asked for."""
        stream = self._live_stream()
        while (arrival := stream.take(0)) is not None:
            self._throw_away(stream, arrival)

    def _throw_away(self, stream: FrameStream, arrival: Arrival) -> None:
        stream.give_back(arrival)
        self._last_id = arrival.frame_id
        if arrival.whole:
            self._stale += 1
            log.warning("camera %s: frame %d is stale and was discarded", self.name, arrival.frame_id)

    # --- exposures ---------------------------------------------------------------------------------------

    def _do_trigger(self) -> None:
        self._discard_outstanding()
        self._drain()
        self._check_control("trigger")
        self._sent_unix_s = time.time()
        self._sent_s = time.monotonic()
        self._outstanding = True
        if not self._hardware:
            self._features.command("TriggerSoftware")

    def _do_wait_exposed(self) -> None:
        stream = self._live_stream()
        if self._hardware:
            self._wait_for_hardware_trigger(stream)
            return
        end_s = self._sent_s + self._exposure_s
        self._sleep_until(end_s - max(0.02 * self._exposure_s, 0.001))
        # A frame that is complete before the exposure can have ended is not ours.
        self._drain()
        self._sleep_until(end_s)
        if not self._status_feature:
            self._sleep_until(end_s + self._config.trigger_latency_s)
            return
        deadline_s = end_s + _TRANSFER_MARGIN_S
        while self._features.flag("AcquisitionStatus"):
            if time.monotonic() > deadline_s:
                self._restart()
                raise self._frame_lost(
                    f"it still exposes {_TRANSFER_MARGIN_S:g} s after the exposure should have ended"
                )
            time.sleep(0.001)

    def _wait_for_hardware_trigger(self, stream: FrameStream) -> None:
        # The end of the exposure is not visible, so it counts as ended when the frame is there.
        deadline_s = self._sent_s + self._config.trigger_timeout_s + self._exposure_s + self._transfer_s()
        while not stream.has_arrival():
            if time.monotonic() > deadline_s:
                self._restart()
                raise self._frame_lost(
                    f"no signal at {self._config.trigger_line} within {self._config.trigger_timeout_s:g} s"
                )
            self._check_control("wait for the hardware trigger")
            time.sleep(0.001)

    def _do_frame(self) -> Frame:
        stream = self._live_stream()
        deadline_s = self._sent_s + self._exposure_s + self._transfer_s()
        if self._hardware:
            deadline_s += self._config.trigger_timeout_s
        while True:
            arrival = stream.take(_SLICE_S)
            if arrival is None:
                self._check_control("wait for the frame")
                if time.monotonic() > deadline_s:
                    # A camera that is gone says so here, seconds before the heartbeat would.
                    self._restart()
                    raise self._frame_lost(f"no frame within {time.monotonic() - self._sent_s:.2f} s of the trigger")
                continue
            if self._is_stale(arrival):
                self._throw_away(stream, arrival)
                continue
            self._outstanding = False
            self._last_id = arrival.frame_id
            try:
                return self._make_frame(arrival)
            finally:
                stream.give_back(arrival)

    def _is_stale(self, arrival: Arrival) -> bool:
        if arrival.first_packet_s < self._sent_unix_s:
            return True
        # 16-bit frame ids go from 65535 to 1; ids are compared on that circle.
        return self._last_id is not None and (arrival.frame_id - self._last_id) % 65535 > 65535 // 2

    def _make_frame(self, arrival: Arrival) -> Frame:
        if not arrival.whole:
            raise self._frame_lost(f"frame {arrival.frame_id} is not whole ({arrival.status})")
        fmt = self._pixel_format()
        announced = arrival.image_layout()
        if announced != (fmt.code, *self._size):
            raise self._frame_lost(
                f"frame {arrival.frame_id} says code 0x{announced[0]:08x}, {announced[1]} x {announced[2]} pixels,"
                f" but 0x{fmt.code:08x}, {self._size[0]} x {self._size[1]} was set"
            )
        pixels = fmt.decode(arrival.memory, *self._size, shift=self._config.shift)
        self._check_alignment(fmt, arrival.memory, pixels)
        pixels.flags.writeable = False
        host_time_s = arrival.first_packet_s if self._hardware else self._sent_unix_s
        return Frame(pixels, arrival.frame_id, arrival.camera_time_ns, host_time_s)

    def _check_alignment(self, fmt: PixelFormat, memory: NDArray[np.uint8], pixels: NDArray[np.uint16]) -> None:
        """A wrong `bits` or `shift` in the rig file shows in the counts: refuse to hand out such a frame."""
        shift, bits = self._config.shift, self.bits
        found = ""
        if shift and fmt.layout == "plain" and fmt.bits_in_memory == 16:
            below = int(np.bitwise_or.reduce(memory[: fmt.payload_bytes(*self._size)].view("<u2")))
            if below & ((1 << shift) - 1):
                found = f"the {shift} low bits are not empty"
        if bits < fmt.bits - shift and int(pixels.max()) >> bits:
            found = f"a count of {int(pixels.max())} needs more than {bits} bits"
        if found:
            raise UnknownPixelFormat(
                f"camera {self.name}, {fmt.name} with bits {bits} and shift {shift}",
                found,
                "Correct `bits` and `shift` in the rig file; the camera's manual says how it aligns its data",
            )

    def _discard_outstanding(self) -> None:
        """Wait for an exposure that nobody collected, and throw its frame away."""
        if not self._outstanding or self._stream is None:
            self._outstanding = False
            return
        stream = self._live_stream()
        deadline_s = self._sent_s + self._exposure_s + self._transfer_s()
        while not self._hardware and time.monotonic() < deadline_s:
            arrival = stream.take(_SLICE_S)
            if arrival is None:
                self._check_control("wait for an abandoned exposure")
                continue
            ours = not self._is_stale(arrival)
            self._throw_away(stream, arrival)
            if ours:
                self._outstanding = False
                return
        self._restart()

    def _transfer_s(self) -> float:
        return self._pixel_format().payload_bytes(*self._size) / _SLOWEST_BYTES_S + _TRANSFER_MARGIN_S

    def _sleep_until(self, end_s: float) -> None:
        while (rest_s := end_s - time.monotonic()) > 0:
            time.sleep(min(rest_s, _SLICE_S))
            self._check_control("expose")

    def _check_control(self, what: str) -> None:
        if self._features.control_is_lost():
            raise self._features.lost(what, "its heartbeat stopped")

    def _frame_lost(self, came_back: str) -> FrameLost:
        return FrameLost(f"camera {self.name}, take a frame", came_back, "Capture the state again")

    # --- end ---------------------------------------------------------------------------------------------

    def _do_statistics(self, retakes: int) -> StreamStatistics:
        now = {} if self._stream is None else self._stream.counters()

        def total(name: str) -> int:
            return self._counted.get(name, 0) + now.get(name, 0)

        return StreamStatistics(
            completed=total("n_completed_buffers"),
            failures=total("n_failures"),
            underruns=total("n_underruns"),
            missing_packets=total("n_missing_packets"),
            resent_packets=total("n_resent_packets"),
            retakes=retakes,
            stale_discarded=self._stale,
        )

    def _do_close(self) -> None:
        # A camera that is gone makes every command wait for its time-out, so it is asked nothing more.
        if not self._features.control_is_lost():
            with contextlib.suppress(CameraError), self._features.asking("stop"):
                self._camera.stop_acquisition()
        self._close_stream()
        del self._features
        del self._camera
