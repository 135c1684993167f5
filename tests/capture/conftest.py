"""A rig that is only a record of what the runner asks of it: no devices, no wire, and a clock that jumps."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from acquisition.capture.runner import CaptureRunner
from acquisition.stop_request import StopRequest
from drivers.camera import CameraSettings
from drivers.errors import FrameLost
from drivers.frame import Frame
from drivers.motion import Position
from processing.instrument.states import StateTable
from processing.storage.captures.schema import Detector
from simulators.clock import ManualClock

MOVE_S, LATE_S = 0.75, 0.125
FULL_SCALE = 4095
BLACK = 100.0


class RecordedAxis:
    """Stands where it was sent, but for `off_deg`; a degree takes it a hundredth of a second."""

    def __init__(self, rig: "RecordedRig", name: str) -> None:
        self.rig, self.name = rig, name
        self.config = SimpleNamespace(tolerance_deg=0.01, unit="deg")
        self.deg = self.off_deg = 0.0

    def move_time_s(self, distance_deg: float) -> float:
        return abs(distance_deg) / 100

    def read_position(self) -> Position:
        self.rig.note("read", self.name)
        return Position(self.deg + self.off_deg, round(1000 * self.deg), True)


class RecordedExposure:
    """Ends `LATE_S` after the exposure time; its frame is what the rig's `picture` gives."""

    def __init__(self, rig: "RecordedRig", number: int) -> None:
        self.rig, self.number = rig, number

    def wait_exposed(self) -> None:
        settings = self.rig.settings
        if self.number in self.rig.never_exposed:
            raise FrameLost("camera, expose", "it still exposes", "Capture the state again")
        self.rig.clock.sleep_s((settings.exposure_s or 0.0) * (settings.frame_average or 1) + LATE_S)
        self.rig.note("exposed", self.number)
        self.rig.during_exposure(self.number)

    def frame(self) -> Frame:
        self.rig.note("frame", self.number)
        if self.number in self.rig.lost:
            raise FrameLost("camera, take a frame", "no frame within 1 s", "Capture the state again")
        return Frame(self.rig.picture(self.number), self.number, 10 * self.number, 1000.0 + self.number)


@dataclass
class RecordedRig:
    """What the runner knows of a rig; `events` lists what it asked for, with the time at which it did."""

    events: list[tuple[Any, ...]] = field(default_factory=list)
    clock: ManualClock = field(default_factory=ManualClock)
    time_scale: float = 1.0
    settings: CameraSettings = field(default_factory=CameraSettings)
    lost: set[int] = field(default_factory=set)
    never_exposed: set[int] = field(default_factory=set)
    picture: Callable[[int], np.ndarray] = lambda number: np.full((4, 5), 500 + number, np.uint16)
    during_exposure: Callable[[int], None] = lambda number: None
    door_open: bool = False
    temperature_c: float | None = 31.5
    last_frame: np.ndarray | None = None

    def __post_init__(self) -> None:
        self.axes = {name: RecordedAxis(self, name) for name in ("psg", "psa")}
        self.config = SimpleNamespace(settle_s=0.25, retakes=2, interlocks=())
        self.camera = SimpleNamespace(
            full_scale=FULL_SCALE,
            trigger=self._trigger,
            temperature_c=lambda: self.temperature_c,
            applied=CameraSettings,
        )
        self.source: Any = SimpleNamespace(
            set_light=lambda on: self.note("light", on), interlock_open=lambda: self.door_open
        )
        self._exposures = 0

    def note(self, *event: object) -> None:
        self.events.append((round(self.clock.now_s(), 6), *event))

    def light_losses(self) -> int:
        return 0

    def guard_news(self) -> list[str]:
        return []

    def require_camera(self) -> Any:
        return self.camera

    def _trigger(self) -> RecordedExposure:
        self._exposures += 1
        self.note("trigger", self._exposures)
        return RecordedExposure(self, self._exposures)

    def is_free(self, targets_deg: Mapping[str, float]) -> bool:
        return True

    def start_moves(self, targets_deg: Mapping[str, float]) -> dict[str, Any]:
        self.note("start", dict(targets_deg), list(targets_deg))
        return {
            name: SimpleNamespace(expected_s=MOVE_S, target_deg=target, start=None)
            for name, target in targets_deg.items()
        }

    def wait(self, motions: Mapping[str, Any]) -> dict[str, Position]:
        if motions:
            self.clock.sleep_s(MOVE_S / self.time_scale)
        for name, motion in motions.items():
            self.axes[name].deg = motion.target_deg
        self.note("arrived", list(motions))
        return {
            name: Position(motion.target_deg, round(1000 * motion.target_deg), True) for name, motion in motions.items()
        }

    def set_exposure(self, exposure_s: float, repeats: int) -> CameraSettings:
        self.settings = CameraSettings(exposure_s=exposure_s, frame_average=repeats)
        return self.settings

    def stop(self) -> None:
        self.note("stop")

    def rest(self) -> None:
        self.note("rest")

    def times(self, kind: str) -> list[float]:
        return [event[0] for event in self.events if event[1] == kind]


class RecordedWriter:
    """Keeps the states handed over."""

    def __init__(self) -> None:
        self.records: list[Any] = []
        self.exposures: list[Any] = []
        self.asked: Counter[str] = Counter()
        self.blocked = False

    def put(self, record: Any) -> None:
        self.records.append(record)

    def is_settled(self) -> bool:
        return not self.blocked

    def settle(self) -> None:
        self.asked["settle"] += 1

    def forget(self) -> None:
        self.asked["forget"] += 1

    def set_exposure(self, exposure_s: Any) -> None:
        self.exposures.append(exposure_s.tolist())

    def states(self) -> list[int]:
        return [record.state for record in self.records]


@pytest.fixture
def rig() -> RecordedRig:
    return RecordedRig()


@pytest.fixture
def runner_of(rig: RecordedRig) -> Callable[..., CaptureRunner]:
    """Makes a runner on the recorded rig; keywords are columns of its table and options of the runner."""

    def make(
        psg: tuple[float, ...] = (0.0, 10.0, 20.0),
        psa: tuple[float, ...] | None = None,
        exposure_s: tuple[float, ...] | float = 0.5,
        role: tuple[Any, ...] | None = None,
        repeats: int = 1,
        **options: Any,
    ) -> CaptureRunner:
        n = len(psg)
        table = StateTable(
            angles_deg={"psg": np.array(psg), "psa": np.zeros(n) if psa is None else np.array(psa)},
            exposure_s=np.broadcast_to(np.asarray(exposure_s, float), n).copy(),
            role=role or ("sample",) * n,
            repeats=np.full(n, repeats),
        )
        detector = Detector(black_level_counts=BLACK)
        writer: Any = RecordedWriter()
        return CaptureRunner(rig, table, writer, detector, stop=StopRequest(), **options)  # type: ignore[arg-type]

    return make
