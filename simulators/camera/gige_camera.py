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
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from drivers.aravis_library import load_aravis
from drivers.clock import REAL, Clock
from drivers.errors import CameraError
from drivers.pixel_formats import PixelFormat, pixel_format
from simulators.camera import gige_features as features
from simulators.camera.loopback_address import LoopbackAddress

# Frames start on this grid. A finer one shortens the wait, but Aravis spins through the last millisecond of each.
_GRID_HZ = 100.0
# Registers of Aravis' own description that give GainRaw.
_GAIN_RAW = 0x110

_FillPattern = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)


@dataclass(frozen=True, slots=True)
class ExposureInfo:
    """What the camera is set to for one exposure.

    Attributes
    ----------
    exposure_s, gain_db, black_level :
        As the driver set them; `black_level` in counts. `gain_db` holds GainRaw on the "aravis" description.
    frame_id : int
        1 to 65535, then again 1.
    width, height, offset_x, offset_y, binning, decimation : int
        Region in pixels as they are sent, after binning and decimation.
    reverse_x, reverse_y : bool
        Mirrored before the region is cut out.
    """

    exposure_s: float
    gain_db: float
    black_level: float
    frame_id: int
    width: int
    height: int
    offset_x: int
    offset_y: int
    binning: int
    decimation: int = 1
    reverse_x: bool = False
    reverse_y: bool = False

    def region_of(self, sensor: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """What is sent of the counts of the whole sensor; binned pixels are averaged, whatever stands before them."""
        b, d = self.binning, self.decimation
        rows, columns = (size // b * b for size in sensor.shape)
        blocks = sensor[:rows, :columns].reshape(rows // b, b, columns // b, b)
        pixels = blocks.mean(axis=(1, 3)).round().astype(np.uint16) if b > 1 else sensor
        pixels = pixels[::d, ::d][:: -1 if self.reverse_y else 1, :: -1 if self.reverse_x else 1]
        cut = pixels[self.offset_y : self.offset_y + self.height, self.offset_x : self.offset_x + self.width]
        return np.ascontiguousarray(cut)


PixelSource = Callable[[ExposureInfo], NDArray[np.uint16]]


class GigeCamera:
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
    description : {"sfnc", "aravis"}
        Features under their SFNC names, or Aravis' own description with older names (ExposureTimeAbs, GainRaw).
    wait_s : float
        How long to wait for the address if another simulated camera has it; real time, as that one is another program.
    clock : drivers.clock.Clock
        What exposures are counted by; the driver's own.
    arming_s : float
        Time after an exposure in which a trigger is ignored.
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
        description: Literal["sfnc", "aravis"] = "sfnc",
        wait_s: float = 60.0,
        clock: Clock = REAL,
        arming_s: float = 0.0,
    ) -> None:
        self.serial = serial
        self.address = address
        self._size = (width, height)
        self._source = pixel_source
        self._bits = bits
        self._lost_ratio = lost_ratio
        self._description = description
        self._wait_s = wait_s
        self._clock = clock
        self._arming_s = arming_s
        self._armed_at_s = 0.0
        #: Triggers that came before the camera was armed.
        self.ignored_triggers = 0
        # Holds frames of exposures that start from now on back, as a busy host or a full link does.
        self.delivery_delay_s = 0.0
        self._error: BaseException | None = None
        self._gone = threading.Event()
        self._camera: Any = None
        self._memory: Any = None
        self._loopback = LoopbackAddress(address)
        self._library = ctypes.CDLL("libaravis-0.8.so.0")
        self._library.arv_buffer_get_data.restype = ctypes.c_void_p
        self._library.arv_buffer_get_data.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
        self._library.arv_buffer_get_frame_id.restype = ctypes.c_uint64
        self._library.arv_buffer_get_frame_id.argtypes = [ctypes.c_void_p]
        self._library.arv_fake_camera_set_fill_pattern.argtypes = [ctypes.c_void_p, _FillPattern, ctypes.c_void_p]
        # ctypes frees the callback when the last reference goes; Aravis would then call into nothing.
        self._callback = _FillPattern(self._fill)

    # --- life --------------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        if error is None:
            self.check()

    def start(self) -> None:
        """Start the camera, also again after `vanish`.

        Raises
        ------
        CameraError
            The address is taken or does not exist.
        """
        aravis, _ = load_aravis()
        self._loopback.take(self._wait_s)
        with tempfile.TemporaryDirectory() as folder:
            path = None
            if self._description == "sfnc":
                path = Path(folder) / "camera.xml"
                path.write_text(features.sfnc_description(*self._size))
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
        self._camera, self._memory = camera, camera.get_fake_camera()
        self._power_up()
        # hash() of a GObject wrapper is the object's address.
        self._library.arv_fake_camera_set_fill_pattern(hash(self._memory), self._callback, None)
        self.lost_ratio = self._lost_ratio

    def stop(self) -> None:
        """End the camera and let the next one have its address."""
        self.vanish()
        self._loopback.release()

    def vanish(self) -> None:
        """End the camera at once, as if its plug was pulled; `start` plugs it in again.

        The address stays ours until `stop`: a driver that does not know yet must not talk to another camera there.
        """
        if self._camera is None:
            return
        self._gone.set()
        # No frame must leave with Aravis' own pattern, and no Python may run while its thread is joined.
        self._camera.set_property("gvsp-lost-ratio", 1.0)
        self._library.arv_fake_camera_set_fill_pattern(hash(self._memory), _FillPattern(), None)
        self._camera = self._memory = None

    def check(self) -> None:
        """Raise the error of the pixel source, if it had one."""
        error, self._error = self._error, None
        if error is not None:
            raise error

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
        self._write(features.TRIGGER_SOURCE, 1)
        self._write(features.SOFTWARE_TRIGGER, 1)

    def write_register(self, address: int, value: int) -> None:
        """Write a 32-bit register, behind the back of whoever controls the camera."""
        self._write(address, value)

    def register(self, address: int) -> int:
        """Read a 32-bit register, as a look into the camera from behind."""
        return self._read(address)

    # --- registers ---------------------------------------------------------------------------------------

    def _power_up(self) -> None:
        width, height = self._size
        self._memory.set_trigger_frequency(_GRID_HZ)
        for address, value in (
            (features.SENSOR_WIDTH, width),
            (features.SENSOR_HEIGHT, height),
            (features.WIDTH, width),
            (features.HEIGHT, height),
            (features.PIXEL_FORMAT, pixel_format("Mono16").code),
            (features.GAIN_AUTO, 2),
            (features.GAMMA_ENABLE, 1),
            (features.DECIMATION_X, 1),
            (features.DECIMATION_Y, 1),
            (features.TRIGGER_ARMED, 1),
        ):
            self._write(address, value)
        for address, number in (
            (features.GAIN_DB, 0.0),
            (features.BLACK_LEVEL, 0.0),
            (features.TEMPERATURE_C, 38.5),
            (features.GAMMA, 0.45),
        ):
            high, low = struct.unpack(">II", struct.pack(">d", number))
            self._write(address, high)
            self._write(address + 4, low)

    def _write(self, address: int, value: int) -> None:
        self._memory.write_register(address, value)

    def _read(self, address: int) -> int:
        return int(self._memory.read_register(address)[1])

    def _read_float(self, address: int) -> float:
        return float(struct.unpack(">d", struct.pack(">II", self._read(address), self._read(address + 4)))[0])

    # --- the exposure, in the camera's own thread --------------------------------------------------------

    def _fill(self, buffer: int, _: int, exposure_us: int, gain_raw: int, code: int) -> None:
        start_s, delay_s = self._clock.now_s(), self.delivery_delay_s
        camera = self._camera
        if start_s < self._armed_at_s and camera is not None:
            self.ignored_triggers += 1
            camera.set_property("gvsp-lost-ratio", 1.0)
            return
        try:
            info = self._info(buffer, exposure_us, gain_raw)
            fmt = pixel_format(code)
            data = fmt.encode(self._checked(self._source(info), info, fmt))
            ctypes.memmove(self._library.arv_buffer_get_data(buffer, None), data.ctypes.data, data.nbytes)
            if camera is not None and not self._gone.is_set():
                camera.set_property("gvsp-lost-ratio", self._lost_ratio)
        except BaseException as error:  # noqa: BLE001 - nothing may pass into C; check() raises it where it is seen
            self._error = self._error or error
            if camera is not None:
                camera.set_property("gvsp-lost-ratio", 1.0)
        del camera
        self._arm_after(start_s + exposure_us * 1e-6)
        # The frame is sent when this returns, and no frame leaves a camera before its exposure has ended.
        end_s = start_s + exposure_us * 1e-6 + delay_s
        while (left_s := end_s - self._clock.now_s()) > 0 and not self._gone.wait(left_s):
            pass

    def _arm_after(self, exposed_s: float) -> None:
        if self._arming_s <= 0 or self._gone.is_set():
            return
        self._armed_at_s = exposed_s + self._arming_s
        self._write(features.TRIGGER_ARMED, 0)
        # A little late, so that what the register says holds.
        wait_s = max(0.0, self._armed_at_s - self._clock.now_s() + 2e-3)
        timer = threading.Timer(wait_s, self._arm)
        timer.daemon = True
        timer.start()

    def _arm(self) -> None:
        if self._memory is not None:
            self._write(features.TRIGGER_ARMED, 1)

    def _info(self, buffer: int, exposure_us: int, gain_raw: int) -> ExposureInfo:
        sfnc = self._description == "sfnc"
        return ExposureInfo(
            exposure_s=exposure_us * 1e-6,
            gain_db=self._read_float(features.GAIN_DB) if sfnc else float(gain_raw),
            black_level=self._read_float(features.BLACK_LEVEL) if sfnc else 0.0,
            frame_id=int(self._library.arv_buffer_get_frame_id(buffer)),
            width=self._read(features.WIDTH),
            height=self._read(features.HEIGHT),
            offset_x=self._read(features.OFFSET_X),
            offset_y=self._read(features.OFFSET_Y),
            binning=self._read(features.BINNING_X),
            decimation=self._read(features.DECIMATION_X) if sfnc else 1,
            reverse_x=sfnc and bool(self._read(features.REVERSE_X)),
            reverse_y=sfnc and bool(self._read(features.REVERSE_Y)),
        )

    def _checked(self, pixels: NDArray[np.uint16], info: ExposureInfo, fmt: PixelFormat) -> NDArray[np.uint16]:
        if pixels.shape != (info.height, info.width) or pixels.dtype != np.uint16:
            raise ValueError(
                f"the pixel source gave {pixels.dtype} {pixels.shape}, not uint16 {(info.height, info.width)}"
            )
        if self._bits < fmt.bits and int(pixels.max()) >> self._bits:
            raise ValueError(f"the pixel source gave {int(pixels.max())}, more than {self._bits} bits hold")
        if fmt.bits < self._bits:
            return pixels >> np.uint16(self._bits - fmt.bits)
        return pixels
