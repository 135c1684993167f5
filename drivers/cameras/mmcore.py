"""A camera of Micro-Manager, through the core of this process (pymmcore-plus).

Facts: the interface of MMCore. A snap returns when the light is collected, so the bench may move then; it runs in a
thread, because it cannot be told to end. The core has one image for all its cameras: nothing else may snap meanwhile.
There are no time stamps and no numbers of frames. Gain, black level and triggers have no common unit or name there:
they are `properties`. Tried with a camera written in Python and with DemoCamera.
"""

import threading
import time
from contextlib import AbstractContextManager
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from drivers.camera import Camera, CameraIdentity, CameraSettings, StreamStatistics
from drivers.clock import REAL, Clock
from drivers.errors import CameraBusy, CameraLost, CameraNotFound, FrameLost, SettingRefused
from drivers.frame import Frame
from drivers.micromanager import NOT_TOLD, asking, loaded_devices, running_core

# Ctrl-C gets through between two looks.
_SLICE_S = 0.02
# Rounding of an exposure that is no refusal, seconds.
_EXPOSURE_FLOOR_S = 20e-6
_WITHOUT_A_COMMON_NAME = ("gain_db", "black_level", "decimation", "reverse_x", "reverse_y", "packet_size")
# Cameras that a driver of this process has: the core itself would give one to any number.
_taken: set[str] = set()


class Config(BaseModel):
    """A camera of Micro-Manager in the rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["mmcore"] = "mmcore"
    device: str = Field(description="label of the camera in the core")
    configuration: Path | None = Field(
        default=None, description="configuration file that is loaded if the core does not hold the device yet"
    )
    settings: CameraSettings = Field(default=CameraSettings(), description="used where a plan leaves a setting open")
    properties: dict[str, str] = Field(default={}, description="any properties, set in this order and read back")
    bits: int | None = Field(default=None, ge=8, le=16, description="real bits, where the core does not know them")
    polarized: bool = Field(default=False, description="the pixels are those of a polarization mosaic")
    colours: Literal["", "RG", "GR", "GB", "BG"] = Field(
        default="", description="filters over the first two pixels of the first row, where they are a colour mosaic"
    )
    retakes: int = Field(default=3, ge=0, description="how often a lost frame is taken again")
    transfer_s: float = Field(default=5.0, gt=0, description="longest time from the end of an exposure to its frame")


class _Snap:
    """One exposure in a thread of its own."""

    def __init__(self, core: Any, device: str) -> None:
        self._core, self._device = core, device
        self.failure: Exception | None = None
        self.exposed = threading.Event()
        self.sent_unix_s = time.time()
        threading.Thread(target=self._run, name=f"snap {device}", daemon=True).start()

    def _run(self) -> None:
        try:
            self._core.setCameraDevice(self._device)
            self._core.snapImage()
        except Exception as error:  # noqa: BLE001 - an adapter raises what it likes; told where the frame is awaited
            self.failure = error
        self.exposed.set()


class MMCoreCamera(Camera):
    """A camera opened by `open`."""

    def __init__(self, name: str, config: Config, core: Any, clock: Clock) -> None:
        super().__init__(name, config.retakes)
        self._config, self._core, self._clock = config, core, clock
        self._snap: _Snap | None = None
        self._sent_s = 0.0
        self._frames = self._failures = self._stale = 0
        self._sensor = (0, 0)
        # Known beforehand: while it snaps, a camera may not answer.
        self._exposure_s = 0.0
        self._bits = config.bits or 0

    @property
    def bits(self) -> int:
        """Real bits of a pixel: those that the core tells, or `bits` of the rig file."""
        return self._bits or self._read_bits()

    def _read_bits(self) -> int:
        with self._asking("read the bits"):
            self._core.setCameraDevice(self._config.device)
            return self._config.bits or int(self._core.getImageBitDepth())

    def describe(self) -> CameraIdentity:
        """Which camera this is, as far as the core tells it."""
        self._require_open()
        device = self._config.device
        with self._asking("describe itself"):
            bits = self.bits
            return CameraIdentity(
                kind=self._config.kind,
                vendor=self._core.getDeviceLibrary(device),
                model=self._core.getDeviceName(device),
                serial_number=self._property("CameraID") or NOT_TOLD,
                firmware=NOT_TOLD,
                address=device,
                interface="Micro-Manager",
                interface_mtu=None,
                packet_size=None,
                packet_delay=None,
                resend=None,
                sensor_width=self._sensor[0],
                sensor_height=self._sensor[1],
                pixel_format=self._property("PixelType") or f"{bits} bit",
                pixel_format_code=None,
                bits=bits,
                shift=0,
                polarized=self._config.polarized,
                colours=self._config.colours,
                library=f"pymmcore-plus {version('pymmcore-plus')}, {self._core.getVersionInfo()}",
            )

    def temperature_c(self) -> float | None:
        """Temperature of the sensor in degrees Celsius; None where the adapter does not tell it."""
        self._require_open()
        told = self._property("CCDTemperature")
        return float(told) if told else None

    def node_map(self) -> dict[str, str]:
        """Every property of the camera with its value."""
        self._require_open()
        with self._asking("read the properties"):
            names = self._core.getDevicePropertyNames(self._config.device)
            return {name: str(self._core.getProperty(self._config.device, name)) for name in names}

    # --- settings ----------------------------------------------------------------------------------------

    def _do_configure(self, settings: CameraSettings) -> CameraSettings:
        self._discard_outstanding()
        settings = self._config.settings.model_copy(update=settings.model_dump(exclude_none=True))
        for name in _WITHOUT_A_COMMON_NAME:
            if getattr(settings, name):
                raise self._refused(f"set {name}", "Micro-Manager has no common name for it: use `properties`")
        if settings.trigger == "hardware":
            raise self._refused("hardware trigger", "a snap starts its exposure by itself")
        self._set_property("PixelType", settings.pixel_format)
        self._set_property("Binning", settings.binning)
        for name, value in self._config.properties.items():
            self._set_property(name, value)
        self._set_region(settings)
        if settings.exposure_s is not None:
            self._set_exposure(settings.exposure_s)
        return self._read_back(settings.frame_average)

    def _set_property(self, name: str, value: str | int | None) -> None:
        # A camera that cannot bin has a binning of 1.
        if value is None or (value == 1 and not self._core.hasProperty(self._config.device, name)):
            return
        with self._setting(f"set {name} to {value}"):
            self._core.setProperty(self._config.device, name, value)
            back = str(self._core.getProperty(self._config.device, name))
        if back != str(value):
            raise self._refused(f"set {name} to {value}", f"it reads back {back}")

    def _set_exposure(self, exposure_s: float) -> None:
        asked = f"set the exposure to {exposure_s:g} s"
        with self._setting(asked):
            self._core.setExposure(self._config.device, 1e3 * exposure_s)
            back_s = 1e-3 * float(self._core.getExposure(self._config.device))
        if abs(back_s - exposure_s) > max(_EXPOSURE_FLOOR_S, 1e-3 * exposure_s):
            raise self._refused(asked, f"it reads back {back_s:g} s")

    def _set_region(self, settings: CameraSettings) -> None:
        device = self._config.device
        with self._setting("set the region"):
            self._core.setCameraDevice(device)
            self._core.clearROI()
            self._sensor = (int(self._core.getImageWidth()), int(self._core.getImageHeight()))
            left, top = settings.offset_x or 0, settings.offset_y or 0
            region = (left, top, settings.width or self._sensor[0] - left, settings.height or self._sensor[1] - top)
            if region != (0, 0, *self._sensor):
                self._core.setROI(device, *region)
            back = tuple(int(value) for value in self._core.getROI(device))
        if back != region:
            raise self._refused(f"set the region to {region}", f"it reads back {back}")

    def _read_back(self, frame_average: int | None) -> CameraSettings:
        with self._asking("read the settings"):
            left, top, width, height = (int(value) for value in self._core.getROI(self._config.device))
            self._exposure_s = 1e-3 * float(self._core.getExposure(self._config.device))
            self._bits = self._read_bits()
            binning = self._property("Binning")
            return CameraSettings(
                exposure_s=self._exposure_s,
                pixel_format=self._property("PixelType") or None,
                width=width,
                height=height,
                offset_x=left,
                offset_y=top,
                binning=int(binning.partition("x")[0]) if binning else None,
                frame_average=frame_average or 1,
                trigger="software",
            )

    def _do_applied(self) -> CameraSettings:
        with self._asking("read the exposure"):
            return CameraSettings(exposure_s=1e-3 * float(self._core.getExposure(self._config.device)))

    def _property(self, name: str) -> str:
        with self._asking(f"read {name}"):
            found = self._core.hasProperty(self._config.device, name)
            return str(self._core.getProperty(self._config.device, name)) if found else ""

    # --- exposures ---------------------------------------------------------------------------------------

    def _do_trigger(self) -> None:
        self._discard_outstanding()
        self._sent_s = self._clock.now_s()
        self._snap = _Snap(self._core, self._config.device)

    def _do_wait_exposed(self) -> None:
        snap, allowed_s = self._snap, self._exposure_s + self._config.transfer_s
        if snap is None:
            raise self._frame_lost("no exposure is under way")
        while not snap.exposed.wait(_SLICE_S):
            if self._clock.now_s() - self._sent_s > allowed_s:
                self._snap = None
                raise CameraLost(f"camera {self.name}, snap", f"nothing within {allowed_s:g} s", "Check the camera")

    def _do_frame(self) -> Frame:
        self._do_wait_exposed()
        snap, self._snap = self._snap, None
        if snap is None:
            raise self._frame_lost("no exposure is under way")
        if snap.failure is not None:
            self._failures += 1
            # A camera that is gone fails at everything else as well.
            with self._asking("say its exposure after a failed snap"):
                self._core.getExposure(self._config.device)
            raise self._frame_lost(str(snap.failure)) from snap.failure
        with self._asking("read the image"):
            image = np.asarray(self._core.getImage())
        pixels = self._counts(image)
        self._frames += 1
        return Frame(pixels, self._frames, 0, snap.sent_unix_s)

    def _counts(self, image: NDArray[Any]) -> NDArray[np.uint16]:
        wanted = (self.settings.height, self.settings.width)
        if image.shape != wanted or image.dtype not in (np.uint8, np.uint16):
            raise self._frame_lost(f"the image is {image.dtype} of {image.shape}, not 8 or 16 bits of {wanted}")
        pixels = image.astype(np.uint16)
        if int(pixels.max(initial=0)) > self.full_scale:
            raise self._frame_lost(f"a count of {int(pixels.max())} needs more than {self.bits} bits")
        pixels.flags.writeable = False
        return pixels

    def _discard_outstanding(self) -> None:
        if self._snap is None:
            return
        self._do_wait_exposed()
        self._stale += self._snap is not None and self._snap.failure is None
        self._snap = None

    def _do_statistics(self, retakes: int) -> StreamStatistics:
        return StreamStatistics(
            completed=self._frames, failures=self._failures, retakes=retakes, stale_discarded=self._stale
        )

    def _do_close(self) -> None:
        # The core stays: it may be another program's part as well.
        _taken.discard(self._config.device)

    # --- errors ------------------------------------------------------------------------------------------

    def _asking(self, what: str) -> AbstractContextManager[None]:
        return asking(f"camera {self.name}, {what}", "Check its power and cable, then start again", CameraLost)

    def _setting(self, what: str) -> AbstractContextManager[None]:
        return asking(f"camera {self.name}, {what}", "Change the setting in the plan or the rig file", SettingRefused)

    def _refused(self, what: str, came_back: str) -> SettingRefused:
        return SettingRefused(
            f"camera {self.name}, {what}", came_back, "Change the setting in the plan or the rig file"
        )

    def _frame_lost(self, came_back: str) -> FrameLost:
        return FrameLost(f"camera {self.name}, take a frame", came_back, "Look at the camera in Micro-Manager")


def open(name: str, config: Config, clock: Clock = REAL) -> MMCoreCamera:
    """Take a camera from the core; nothing is set and nothing is exposed.

    Raises CameraNotFound, CameraBusy, DeviceError: the core does not hold it, it is open here already or runs a
    sequence, or pymmcore-plus is not installed.
    """
    asked = f"camera {name}, open {config.device}"
    core = running_core(asked, config.configuration, config.device)
    if config.device not in core.getLoadedDevices():
        raise CameraNotFound(asked, f"the core holds {loaded_devices(core)}", "Correct `device` or `configuration`")
    if config.device in _taken or core.isSequenceRunning():
        raise CameraBusy(asked, "it is open already, or a sequence runs", "End the other use first")
    _taken.add(config.device)
    return MMCoreCamera(name, config, core, clock)
