"""Axes and cameras of Micro-Manager: the conformance suites over devices that a core of this process holds."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.axes import mmcore as mmcore_axis
from drivers.camera import CameraSettings
from drivers.errors import CommandRejected, FrameLost, MotionFailed, PortNotFound, SettingRefused, WrongDevice
from drivers.serial_link import LineRegistry
from simulators.clock import FastClock, patient_clock
from simulators.conformance import CameraConformance
from simulators.conformance.axis_promises import AxisPromises
from simulators.conformance.camera import CameraTwin, Show
from simulators.conformance.served_axes import FAST, ServedAxes
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.reply_faults import Fault, FaultSchedule

pytest.importorskip("pymmcore_plus")
from pymmcore_plus.core import _mmcore_plus
from pymmcore_plus.experimental.unicore import SimpleCameraDevice, StageDevice, UniMMCore

# It lets every library write its debug lines: those of numba take a tenth of a compilation.
logging.getLogger().setLevel(logging.WARNING)


@pytest.fixture(scope="module")
def core() -> Iterator[Any]:
    """The one core of this process, which takes devices written in Python."""
    before, _mmcore_plus._instance = _mmcore_plus._instance, None
    core = UniMMCore()
    yield core
    core.unloadAllDevices()
    _mmcore_plus._instance = before


class MotorBehindTheCore(Emulator):
    """A motor without a wire: faults act on calls."""

    tells_limits = False

    def call(self) -> None:
        self._apply_faults()
        if "silent" in self.faults.active:
            raise RuntimeError("the device timed out")

    def _do_receive(self, data: bytes) -> None:
        raise NotImplementedError

    def _do_make_foreign(self, reply: bytes) -> bytes:
        raise NotImplementedError


class PythonStage(StageDevice):
    def __init__(self, motor: MotorBehindTheCore) -> None:
        super().__init__()
        self._motor, self._axis = motor, motor.axes[0]

    def home(self) -> None:
        self._motor.call()
        self._axis.home()

    def stop(self) -> None:
        self._motor.call()
        self._axis.stop()

    def set_origin(self) -> None:
        raise NotImplementedError

    def busy(self) -> bool:
        self._motor.call()
        return self._axis.is_moving()

    def set_position_um(self, val: float) -> None:
        self._motor.call()
        if not self._axis.within(val):
            raise ValueError(f"{val} is out of the travel")
        self._axis.move_to(val)

    def get_position_um(self) -> float:
        self._motor.call()
        return self._axis.position_deg()


class NoPort:
    """Where an axis has no wire."""

    path = "micromanager"


@contextmanager
def stage_in(core: Any, homed: bool = True, speed: float = FAST, **options: Any) -> Iterator[ServedAxes]:
    """A stage of the core with the motor behind it."""
    clock = FastClock(speed, base=patient_clock())
    low_deg, high_deg = options.get("limits_deg") or (None, None)
    axis = EmulatedAxis(clock, min_deg=low_deg, max_deg=high_deg, homed=homed, start_deg=0.0 if homed else 15.0)
    motor = MotorBehindTheCore([axis], clock, FaultSchedule())
    core.loadPyDevice("Rotator", PythonStage(motor))
    core.initializeDevice("Rotator")
    config = mmcore_axis.Config(device="Rotator", speed_deg_s=300.0, assume_homed=homed)
    try:
        with LineRegistry(clock=patient_clock()) as lines:
            yield ServedAxes(motor, NoPort(), lines, [config])  # type: ignore[arg-type]
    finally:
        core.unloadDevice("Rotator")


class TestStageOfTheCore(AxisPromises):
    emulator = "mmcore"

    @pytest.fixture(autouse=True)
    def _in_the_core(self, core: Any) -> None:
        self._core = core

    def served(self, kind: str, homed: bool = True, speed: float = FAST, **options: object) -> Any:
        return stage_in(self._core, homed, speed, **options)


def test_a_stuck_stage_a_lost_one_and_an_error_of_its_adapter(core: Any) -> None:
    with stage_in(core, limits_deg=(-90.0, 90.0)) as served:
        axis = served.open()
        with pytest.raises(CommandRejected, match="out of the travel"):
            axis.start_move(100.0)
        served.emulator.faults.add(Fault("stuck"))
        with pytest.raises(MotionFailed, match=r"no progress|deadline"):
            axis.start_move(20.0).wait()
        served.emulator.faults.clear()
        served.emulator.faults.add(Fault("silent"))
        with pytest.raises(CommandRejected, match="timed out"):
            axis.read_position()


def test_units_of_a_stage_are_those_of_the_rig_file(core: Any) -> None:
    with stage_in(core) as served:
        axis = served.open(units_per_deg=2.5)
        assert axis.start_move(-10.0).wait().counts == -25.0
        assert served.emulator.true_deg(0) == -25.0


def test_a_device_that_is_not_there_or_no_stage_is_named(core: Any) -> None:
    with stage_in(core) as served:
        with pytest.raises(PortNotFound, match="the core holds Rotator"):
            served.open(device="Other")
        with pytest.raises(WrongDevice, match="type Core"):
            served.open(device="Core")
        with pytest.raises(CommandRejected, match="load /not/there"):
            served.open(device="Other", configuration="/not/there.cfg")


class PythonCamera(SimpleCameraDevice):
    """12 bits in 16; shows the scene in its region."""

    def __init__(self, show: Show, width: int, height: int) -> None:
        super().__init__()
        self._show, self._size = show, (height, width)
        self._exposure_ms = 10.0
        self.gone = self.losing = False

    def get_exposure(self) -> float:
        if self.gone:
            raise RuntimeError("the camera does not answer")
        return self._exposure_ms

    def set_exposure(self, exposure: float) -> None:
        self._exposure_ms = min(exposure, 60_000.0)

    def sensor_shape(self) -> tuple[int, int]:
        return self._size

    def dtype(self) -> type[np.uint16]:
        return np.uint16

    def snap(self, buffer: NDArray[np.uint16]) -> Mapping[str, Any]:
        left, top, width, height = self.get_roi()
        if not self.gone:
            buffer[top : top + height, left : left + width] = self._show(width, height, self._exposure_ms * 1e-3)
        patient_clock().sleep_s(self._exposure_ms * 1e-3)
        if self.gone or self.losing:
            raise RuntimeError("the transfer failed")
        return {}


class CoreTwin:
    """A camera that the core holds, in place of one on the network."""

    def __init__(self, core: Any, show: Show) -> None:
        self.entry: dict[str, Any] = {"device": "Camera", "bits": 12}
        self.elsewhere: dict[str, Any] = {"device": "NotThere"}
        self.size, self.bits = (128, 64), 12
        self._core, self._show = core, show
        self._camera: PythonCamera | None = None

    def start(self) -> None:
        if self._camera is not None:
            self.stop()
        self._camera = PythonCamera(self._show, *self.size)
        self._core.loadPyDevice("Camera", self._camera)
        self._core.initializeDevice("Camera")

    def stop(self) -> None:
        if self._camera is not None:
            self._core.unloadDevice("Camera")
        self._camera = None

    def vanish(self) -> None:
        assert self._camera is not None
        self._camera.gone = True

    def lose(self, share: float) -> None:
        assert self._camera is not None
        self._camera.losing = share > 0


class TestCameraOfTheCore(CameraConformance):
    kind = "mmcore"

    @pytest.fixture(autouse=True)
    def _in_the_core(self, core: Any) -> None:
        self._core = core

    def make_twin(self, show: Show) -> CameraTwin:
        return CoreTwin(self._core, show)

    @pytest.mark.parametrize(
        "wrong", [{"gain_db": 3.0}, {"trigger": "hardware"}, {"width": 100, "offset_x": 40}, {"reverse_x": True}]
    )
    def test_what_the_core_has_no_name_for_is_refused(self, twin: CameraTwin, wrong: dict[str, Any]) -> None:
        with self.open(twin.entry) as camera, pytest.raises(SettingRefused):
            camera.configure(CameraSettings(**wrong))

    def test_counts_beyond_the_bits_of_the_rig_file_are_no_frame(self, twin: CameraTwin) -> None:
        with self.open(twin.entry | {"bits": 8, "retakes": 0}) as camera:
            camera.configure(CameraSettings(exposure_s=1e-3))
            with pytest.raises(FrameLost, match="more than 8 bits"):
                camera.capture()
