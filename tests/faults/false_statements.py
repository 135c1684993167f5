"""Cameras and axes that report something false, in whole captures: what is reported where.

Run: .venv/bin/python tests/faults/false_statements.py [EACH] [KIND ...]

EACH captures (default 25) of each of the 20 kinds, each from a random state on. Counted are captures that ended with
an error, that took a state again, that have a message in the file, and of which `process reduce` warns. The exit code
is 1 if a capture of the first ten kinds passed without any of these. The last line is of captures without a fault:
every message there is a false alarm.
"""

import random
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from simulated_rig import write_rig

from acquisition.capture import session
from acquisition.capture.job import check_with_devices, prepare
from acquisition.capture.plan import MeasurementPlan
from acquisition.errors import AcquisitionError
from acquisition.rig.config import load_rig
from acquisition.rig.open_rig import open_rig
from acquisition.rig.rig import Rig
from acquisition.screen.observer import Observer
from acquisition.stop_request import StopRequest
from drivers import genicam
from drivers.errors import DeviceError
from drivers.frame import Frame
from processing.reduction.counts_to_signal import CountCorrection
from processing.storage.captures.capture import Capture

TOP = 4095
FAST = {"speed_deg_s": 50_000, "acceleration_deg_s2": 1e7}
PORTS = {
    "rotators": {"kind": "zaber", "axes": 2, **FAST},
    "arm": {"kind": "smc100", "axes": 1, **FAST},
    "shutter": {"kind": "sc10"},
}
#: Darks come first; a fault begins with a light state.
DARKS, STATES = 2, 40

#: Pixels of the first light frame of a capture.
FIRST: list[Any] = []

Change = Callable[[Frame, Frame], Frame]


def _counts(factor: float) -> Change:
    def change(frame: Frame, before: Frame) -> Frame:
        pixels = np.clip((frame.pixels - 64.0) * factor + 64.0, 0, TOP).round().astype(np.uint16)
        return replace(frame, pixels=pixels)

    return change


def _pixels(turn: Callable[[Any], Any]) -> Change:
    return lambda frame, before: replace(frame, pixels=np.ascontiguousarray(turn(frame.pixels)))


def _torn(frame: Frame, before: Frame) -> Frame:
    half = len(frame.pixels) // 2
    return replace(frame, pixels=np.concatenate([frame.pixels[:half], before.pixels[half:]]))


#: What the camera hands out instead of a frame, given it and the one before, and whether once or from then on.
FRAMES: dict[str, tuple[Change, bool]] = {
    "frozen from a state on": (lambda frame, before: replace(frame, pixels=before.pixels), True),
    "one frame again": (lambda frame, before: replace(frame, pixels=before.pixels), False),
    "one frame torn": (_torn, False),
    "one exposure doubled": (_counts(2.0), False),
    "exposure doubled from a state on": (_counts(2.0), True),
    "gain +10 % from a state on": (_counts(1.1), True),
    "gain -10 % from a state on": (_counts(0.9), True),
    "mirrored from a state on": (_pixels(lambda p: p[:, ::-1]), True),
    "one frame upside down": (_pixels(lambda p: p[::-1]), False),
    "turned by 180 deg from a state on": (_pixels(lambda p: p[::-1, ::-1]), True),
    "frame number stands": (lambda frame, before: replace(frame, frame_id=before.frame_id), True),
    "camera clock stands": (lambda frame, before: replace(frame, camera_time_ns=before.camera_time_ns), True),
    "one exposure +10 %": (_counts(1.1), False),
    "an earlier frame again": (lambda frame, before: replace(frame, pixels=FIRST[-1]), False),
}


def _set(names: tuple[str, ...], change: Callable[[float], float]) -> Callable[[Rig], None]:
    def act(rig: Rig) -> None:
        features: Any = rig.require_camera()._setup._features  # type: ignore[attr-defined]
        features.set_number(names, change(features.number(names)))

    return act


def _axis(rig: Rig) -> Any:
    assert rig.simulation is not None
    return rig.simulation.emulators["rotators"].axes[0]


def _restarts(rig: Rig) -> None:
    axis = _axis(rig)
    axis.lose_reference()
    axis._homed = True


def _turned(rig: Rig) -> None:
    axis = _axis(rig)
    axis.move_to(axis.position_deg() + 7.0)


def _slips(rig: Rig) -> None:
    _axis(rig).slip_deg += 30.0


#: What happens to a device before the exposure of a state.
DEVICES: dict[str, Callable[[Rig], None]] = {
    "another program sets the exposure": _set(genicam.EXPOSURE_US, lambda us: 2 * us),
    "another program sets the gain": _set(genicam.GAIN_DB, lambda db: db + 3),
    "another program sets the black level": _set(genicam.BLACK_LEVEL, lambda level: level + 20),
    "a rotator restarts and claims a reference": _restarts,
    "a rotator is turned by hand": _turned,
    "an optic slips, its encoder agrees": _slips,
    "the bench is as it says": lambda rig: None,
}
KINDS = [*FRAMES, *DEVICES]


class _False(Observer):
    """Makes a camera or an axis say something false from a state on."""

    def __init__(self, rig: Rig, kind: str, state: int) -> None:
        self.retakes = 0
        self._rig, self._kind, self._state, self._now = rig, kind, state, -1
        camera: Any = rig.require_camera()
        self._take, self._before, self._acted = camera._do_frame, None, False
        camera._do_frame = self._frame

    def exposing(self, state: int, retake: int) -> None:
        self._now = state
        self.retakes += retake > 0
        if self._kind in DEVICES and state == self._state and not self._acted:
            self._acted = True
            # After the setting, before the trigger: the way back and forth goes through the camera.
            DEVICES[self._kind](self._rig)

    def _frame(self) -> Frame:
        frame: Frame = self._take()
        change, onwards = FRAMES.get(self._kind, (None, False))
        before, hit = self._before, self._now >= self._state if onwards else self._now == self._state
        if change is not None and before is not None and hit and not (self._acted and not onwards):
            self._acted = True
            frame = change(frame, before)
        self._before = frame
        if self._now == DARKS:
            FIRST.append(frame.pixels)
        return frame


def take(kind: str, seed: int, folder: Path) -> tuple[bool, bool, bool, bool]:
    """One capture: ended with an error, took a state again, has a message, and its reduction has a warning."""
    draw = random.Random(f"{kind} {seed}")
    sample = draw.choice(["red_sphere", "red_flat"])
    simulator = {"rows": 64, "columns": 80, "clock_speed": 50, "camera_wait_s": 600, "ports": PORTS, "seed": seed + 1}
    rig_file = write_rig(folder / "rig.yaml", simulator, settle_s=0.0, backlash_deg={}, park_deg={})
    config = load_rig(rig_file)
    plan = MeasurementPlan().with_changes(sample={"name": sample}, darks=DARKS, exposure_s=draw.choice([0.01, 0.02]))
    job, path = prepare(plan, config), folder / "run.h5"
    error = None
    with open_rig(config) as rig:
        false = _False(rig, kind, draw.randint(DARKS + 2, DARKS + STATES - 3))
        try:
            check_with_devices(job, rig, folder)
            session.take(job, rig, path, StopRequest(), observers=[false])
        except (AcquisitionError, DeviceError) as caught:
            error = caught
    result = next(file for file in folder.glob("run.h5*") if file.suffix != ".png")
    with Capture(result) as capture:
        messages = [text for text in capture.closing.get("messages", []) if "false frame" in text]
        warned = bool(capture.closing.get("evidence"))
        if error is None:
            warned = any("state" in text for text in CountCorrection.of(capture).warnings)
    return error is not None, false.retakes > 0, bool(messages), warned


def main() -> int:
    """Print the table."""
    each = int(sys.argv[1]) if len(sys.argv) > 1 else 25
    passed_of_first = 0
    print(f"{'kind':<42} {'captures':>8} {'ended':>6} {'again':>6} {'message':>8} {'reduce':>7} {'passed':>7}")
    for number, kind in enumerate(KINDS):
        if sys.argv[2:] and not any(word in kind for word in sys.argv[2:]):
            continue
        rows = []
        for seed in range(each):
            with tempfile.TemporaryDirectory() as folder:
                rows.append(take(kind, seed, Path(folder)))
        ended, retaken, reports, warned = (sum(column) for column in zip(*rows, strict=True))
        passed = sum(not any(row) for row in rows)
        passed_of_first += passed if number < 10 else 0
        print(f"{kind:<42} {each:>8} {ended:>6} {retaken:>6} {reports:>8} {warned:>7} {passed:>7}", flush=True)
    return int(passed_of_first > 0)


if __name__ == "__main__":
    sys.exit(main())
