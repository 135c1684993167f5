"""Axes, camera and light of a rig as Python devices of a Micro-Manager core, for its own acquisition engine.

    from pymmcore_plus.experimental.unicore import UniMMCore

    core = UniMMCore()
    with rig_in_core(core, "configs/rigs/simulated.yaml"):
        core.setPosition("psg", 30.0)
        core.snapImage()

A core counts in micrometres; here one of them is a degree. What a rig file forbids stays forbidden: every move goes
through the rig. A move has ended when `setPosition` returns, and one that is refused or fails is its exception.
"""

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymmcore_plus.experimental.unicore import ShutterDevice, SimpleCameraDevice, StageDevice

from acquisition.rig.config import load_rig
from acquisition.rig.open_rig import open_rig
from acquisition.rig.rig import Rig
from drivers.errors import DeviceError
from drivers.source import LightSource

#: Labels of the other devices; axes have their names in the rig file.
CAMERA, SHUTTER = "Camera", "Light"


class AxisStage(StageDevice):
    """An axis of the rig as a stage, degrees in place of micrometres."""

    def __init__(self, name: str, rig: Rig, turn: threading.Lock) -> None:
        super().__init__()
        self._name, self._rig, self._turn = name, rig, turn

    def set_position_um(self, val: float) -> None:
        """Go to an angle, degrees, and wait."""
        with self._turn:
            self._rig.move({self._name: float(val)})

    def get_position_um(self) -> float:
        """Angle as read back, degrees."""
        return self._rig.axes[self._name].read_position().deg

    def home(self) -> None:
        """Home the axis, as far as the rig file lets it."""
        with self._turn:
            self._rig.home([self._name])

    def stop(self) -> None:
        """Stop the axis where it is."""
        self._rig.axes[self._name].stop()

    def set_origin(self) -> None:
        """Refused: the zero of an axis stands in the rig file."""
        raise NotImplementedError(f"the zero of {self._name} is `zero_deg` in the rig file")


class RigShutter(ShutterDevice):
    """The light of the rig; of a rig without a source it does nothing."""

    def __init__(self, source: LightSource | None) -> None:
        super().__init__()
        self._source, self._open = source, False

    def get_open(self) -> bool:
        """Whether light was let through last."""
        return self._open

    def set_open(self, open: bool) -> None:
        """Let light through, or shut it."""
        if self._source is not None:
            self._source.set_light(open)
        self._open = open


class RigCamera(SimpleCameraDevice):
    """The camera of the rig; whole frames, exposure in milliseconds. The light is on while a frame is taken."""

    def __init__(self, rig: Rig, shutter: RigShutter, turn: threading.Lock) -> None:
        super().__init__()
        self._rig, self._shutter, self._turn = rig, shutter, turn
        self._exposure_s = 0.02

    def get_exposure(self) -> float:
        """Exposure of the next frames, milliseconds."""
        return 1000 * self._exposure_s

    def set_exposure(self, exposure: float) -> None:
        """Take the next frames with this exposure, milliseconds; it becomes what the camera takes it for.

        Raises DeviceError; the exposure stays as it was then.
        """
        with self._turn:
            try:
                taken_s = self._rig.set_exposure(exposure / 1000, 1).exposure_s
            except DeviceError:
                # The refusal has left the camera without settings.
                self._rig.set_exposure(self._exposure_s, 1)
                raise
            self._exposure_s = taken_s or exposure / 1000

    def sensor_shape(self) -> tuple[int, int]:
        """Rows and columns."""
        settings = self._rig.require_camera().settings
        return settings.height or 0, settings.width or 0

    def dtype(self) -> type[np.uint16]:
        """Of the counts."""
        return np.uint16

    def snap(self, buffer: NDArray[np.uint16]) -> Mapping[str, Any]:
        """Take one frame. The core opens no shutter for a camera in Python, so this does."""
        with self._turn:
            stays_open = self._shutter.get_open()
            try:
                self._shutter.set_open(True)
                buffer[:] = self._rig.require_camera().capture(1)[0].pixels
            finally:
                self._shutter.set_open(stays_open)
        return {}


@contextmanager
def rig_in_core(core: Any, rig_file: Path | str, sample: str = "red_sphere", home: bool = False) -> Iterator[Rig]:
    """The devices of a rig in a core that takes Python devices, until the end of the block.

    Axes have their names in the rig file, the camera is "Camera", the light "Light".

    Parameters
    ----------
    sample : sample that an emulated rig shows.
    home : home axes without a reference now; nothing homes unless asked here or by the rig file.
    """
    config = load_rig(rig_file)
    loaded: list[str] = []

    def load(label: str, device: Any) -> None:
        core.loadPyDevice(label, device)
        loaded.append(label)
        core.initializeDevice(label)

    with open_rig(config) as rig:
        if (home or config.home_at_start) and (missing := rig.unhomed()):
            rig.home(missing)
        rig.show(sample)
        turn, shutter = threading.Lock(), RigShutter(rig.source)
        try:
            for name in rig.axes:
                load(name, AxisStage(name, rig, turn))
            load(SHUTTER, shutter)
            core.setShutterDevice(SHUTTER)
            camera = RigCamera(rig, shutter, turn)
            camera.set_exposure(camera.get_exposure())
            load(CAMERA, camera)
            core.setCameraDevice(CAMERA)
            yield rig
        finally:
            shutter.set_open(False)
            for label in reversed(loaded):
                core.unloadDevice(label)
