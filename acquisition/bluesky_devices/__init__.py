"""Axes, camera and whole captures of a rig as bluesky devices, for an unmodified RunEngine.

    from bluesky import RunEngine
    from bluesky.plans import count, scan

    with open_bench("configs/rigs/simulated.yaml") as bench:
        RE = RunEngine()
        RE(scan([bench.camera], bench.axes["psg"], 0, 90, 10))
        RE(count([bench.capture(MeasurementPlan(omega_deg=35), "captures")]))

bluesky knows a device by what it can do, so nothing of bluesky is imported here. What a rig file forbids stays
forbidden: every move goes through the rig, and so do limits, poses and interlocks.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from acquisition.bluesky_devices.axis_and_camera import AxisDevice, CameraDevice
from acquisition.bluesky_devices.capture_device import CaptureDevice
from acquisition.bluesky_devices.settings import InterlockDevice, SettingDevice
from acquisition.capture.plan import ARM, MeasurementPlan
from acquisition.rig.config import load_rig
from acquisition.rig.open_rig import open_rig
from acquisition.rig.rig import Rig


class BlueskyBench:
    """An open rig and its devices; made by `open_bench`."""

    def __init__(self, rig: Rig, home: bool) -> None:
        self.rig, self.home = rig, home
        self.turn = threading.Lock()
        self.axes = {name: AxisDevice(name, rig, self.turn) for name in rig.axes}
        self.camera = CameraDevice("camera", rig, self.turn)
        self.exposure = SettingDevice(
            "exposure_s",
            rig,
            self.turn,
            get=lambda: self.camera.exposure_s,
            change=self.camera.change_exposure,
            unit="s",
        )
        self.interlock = InterlockDevice("interlock", rig, self.turn)

    def capture(self, plan: MeasurementPlan, folder: Path | str, name: str = "capture") -> CaptureDevice:
        """A device that takes captures by a plan. Raises PlanRefused."""
        return CaptureDevice(
            name,
            self.rig,
            self.turn,
            plan,
            folder=folder,
            home=self.home,
            arm=self.axes.get(ARM),
            interlock=self.interlock,
        )


@contextmanager
def open_bench(rig_file: Path | str, home: bool = False) -> Iterator[BlueskyBench]:
    """The devices of a rig, open until the end of the block.

    Parameters
    ----------
    home : home axes without a reference now; nothing homes unless asked here or by the rig file.
    """
    config = load_rig(rig_file)
    with open_rig(config) as rig:
        if (home or config.home_at_start) and (missing := rig.unhomed()):
            rig.home(missing)
        bench = BlueskyBench(rig, home)
        try:
            yield bench
        finally:
            bench.interlock.close()
