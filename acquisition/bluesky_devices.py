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

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.capture import session
from acquisition.capture.checks import refuse_failed
from acquisition.capture.header import default_name
from acquisition.capture.job import check_with_devices, job_of, prepare
from acquisition.capture.plan import MeasurementPlan
from acquisition.capture.writer import PARTIAL
from acquisition.errors import AcquisitionError
from acquisition.rig.config import RigConfig, load_rig
from acquisition.rig.rig import Rig
from acquisition.stop_request import StopRequest
from processing.instrument.model import InstrumentModel
from processing.storage.capture import Capture

Readings = dict[str, dict[str, Any]]
#: What a capture says of each of its states, beside the angles: column of the file, and its unit.
COLUMNS = {"exposure_s": "s", "host_time_s": "s", "monitor": "count/s", "saturated_fraction": ""}


class Status:
    """What the RunEngine waits for: done, with or without an error."""

    def __init__(self) -> None:
        self._ended = threading.Event()
        self._error: BaseException | None = None
        self._callbacks: list[Callable[[Status], None]] = []
        self._lock = threading.Lock()

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        return self._ended.is_set()

    @property
    def success(self) -> bool:
        """Whether it has ended well."""
        return self.done and self._error is None

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        """The error, or None. Raises TimeoutError if it has not ended in time."""
        if not self._ended.wait(timeout):
            raise TimeoutError("not done yet")
        return self._error

    def add_callback(self, callback: Callable[[Status], None]) -> None:
        """Have a function called at the end, at once if that has been."""
        with self._lock:
            if not self.done:
                self._callbacks.append(callback)
                return
        callback(self)

    def end(self, error: BaseException | None = None) -> None:
        """Tell everybody who waits."""
        with self._lock:
            self._error = error
            self._ended.set()
        for callback in self._callbacks:
            callback(self)


def in_background(work: Callable[[], None]) -> Status:
    """Do something in a thread of its own; its error becomes the status's."""
    status = Status()

    def run() -> None:
        try:
            work()
        except BaseException as error:  # noqa: BLE001 - whatever it is, the RunEngine must hear of it
            status.end(error)
        else:
            status.end()

    threading.Thread(target=run, name="bluesky device", daemon=True).start()
    return status


class Device:
    """What all have: a name, no parent, and nothing to configure but what `read` tells."""

    parent = None

    def __init__(self, name: str, rig: Rig, turn: threading.Lock) -> None:
        self.name = name
        self.rig = rig
        #: Held while something moves or is exposed: one thing at a time, as the rig's checks assume.
        self.turn = turn

    def read_configuration(self) -> Readings:
        """Nothing that changes seldom."""
        return {}

    def describe_configuration(self) -> Readings:
        """Nothing that changes seldom."""
        return {}


class AxisDevice(Device):
    """An axis of the rig; `set` goes to an angle in degrees, `read` tells where it is at rest."""

    @property
    def hints(self) -> dict[str, Any]:
        """What live tables show."""
        return {"fields": [self.name]}

    @property
    def position(self) -> float:
        """Angle as read back, degrees."""
        return self.rig.axes[self.name].read_position().deg

    def set(self, value: float) -> Status:
        """Go to an angle, degrees. The status fails if it is forbidden, out of limits, or not reached."""

        def move() -> None:
            with self.turn:
                self.rig.move({self.name: float(value)})

        return in_background(move)

    def stop(self, *, success: bool = False) -> None:
        """Stop the axis where it is."""
        self.rig.axes[self.name].stop()

    def read(self) -> Readings:
        """Angle as read back."""
        return _readings({self.name: self.position})

    def describe(self) -> Readings:
        """Unit and source of the angle."""
        return {self.name: _key(f"axis {self.name}, as read back", (), "degree")}


class CameraDevice(Device):
    """The camera; `trigger` takes a frame, `read` gives it with its mean. The light is on while it is staged.

    Attributes
    ----------
    exposure_s : of the next frames; change it between plans.
    sample : what an emulated rig shows.
    """

    _frame: np.ndarray[Any, np.dtype[np.uint16]]
    exposure_s = 0.02
    sample = "red_sphere"

    def stage(self) -> list[Device]:
        """Set the exposure, let light through."""
        with self.turn:
            config = self.rig.config
            if self.rig.simulation is not None:
                model = InstrumentModel.load(next(iter(config.modes.values())).instrument)
                self.rig.simulation.prepare(self.sample, model, config.wavelengths_nm[0])
            self.rig.set_exposure(self.exposure_s, 1)
            if self.rig.source is not None:
                self.rig.source.set_light(True)
        return [self]

    def unstage(self) -> list[Device]:
        """Shut the light."""
        if self.rig.source is not None:
            self.rig.source.set_light(False)
        return [self]

    @property
    def hints(self) -> dict[str, Any]:
        """What live tables show."""
        return {"fields": [f"{self.name}_mean"]}

    def trigger(self) -> Status:
        """Take one frame."""

        def expose() -> None:
            with self.turn:
                self._frame = self.rig.require_camera().capture(1)[0].pixels

        return in_background(expose)

    def read(self) -> Readings:
        """The frame that was taken last, and its mean in counts."""
        return _readings({f"{self.name}_frame": self._frame, f"{self.name}_mean": float(self._frame.mean())})

    def describe(self) -> Readings:
        """Shapes and units."""
        settings = self.rig.require_camera().settings
        shape = (settings.height or 0, settings.width or 0)
        return {
            f"{self.name}_frame": _key("camera, counts (row, column)", shape, "count"),
            f"{self.name}_mean": _key("camera, mean of the frame", (), "count"),
        }


class CaptureDevice(Device):
    """A whole capture: one `trigger` takes all its states into a file, and seals it.

    If the RunEngine pauses, the state that is being taken is finished and the light is shut; when it resumes, the same
    file is gone on with, as `acquire --resume` does. `read` gives the file, and angles and columns of its states;
    the frames stay in the file, which a stream document points to.

    Parameters
    ----------
    plan : of every capture that this device takes.
    folder : for the files, which are named as `acquire` names them.
    """

    def __init__(self, name: str, bench: Bench, plan: MeasurementPlan, folder: Path | str) -> None:
        super().__init__(name, bench.rig, bench.turn)
        self.config, self.plan, self.folder = bench.config, plan, Path(folder)
        self._home = bench.home
        self._job = prepare(plan, bench.config)
        self._stop = StopRequest()
        self._half: Path | None = None
        self._path: Path | None = None
        self._taking: Status | None = None
        self._documents: list[tuple[str, dict[str, Any]]] = []

    def trigger(self) -> Status:
        """Take the capture, or what is missing of one that a pause has interrupted."""
        self._stop = StopRequest()
        self._taking = in_background(self._take)
        return self._taking

    def _take(self) -> None:
        with self.turn:
            half = self._half
            job = self._job if half is None else job_of(half, self.config, self.plan)
            path = self._free_name() if half is None else half
            refuse_failed(check_with_devices(job, self.rig, path.parent))
            run = session.take if half is None else session.resume
            try:
                result = run(job, self.rig, path, self._stop, (), self._home)
            except BaseException:
                # What is there already is gone on with, should the plan be run again.
                partial = path if path.name.endswith(PARTIAL) else path.with_name(path.name + PARTIAL)
                self._half = partial if partial.exists() else None
                raise
        if result.status == "complete":
            self._half, self._path = None, result.path
            self._documents = list(self._asset_documents(result.path))
        else:
            self._half = result.path

    def _free_name(self) -> Path:
        """A name that is not taken: several captures may begin in one second."""
        first = self.folder / default_name(self.plan)
        number, path = 1, first
        while path.exists():
            number += 1
            path = first.with_stem(f"{first.stem}-{number}")
        return path

    def pause(self) -> None:
        """Finish the state that is being taken; called by the RunEngine."""
        if self._taking is not None and not self._taking.done:
            self._stop.request()
            self._taking.exception(timeout=None)

    def resume(self) -> None:
        """Nothing: the RunEngine triggers again, and the capture is gone on with then."""

    def stop(self, *, success: bool = False) -> None:
        """End after the state that is being taken; the file can be gone on with by `acquire --resume`."""
        self._stop.request()

    def _sealed(self) -> Path:
        if self._path is None:
            raise AcquisitionError(f"{self.name} has taken no capture yet; trigger it first.")
        return self._path

    def read(self) -> Readings:
        """File, angles as read back and columns, of the capture that was taken last."""
        with Capture(self._sealed()) as capture:
            values: dict[str, Any] = {f"{self.name}_file": str(capture.path)}
            values |= {f"{self.name}_{axis}_deg": angles for axis, angles in capture.angles_deg.items()}
            values |= {f"{self.name}_{column}": capture.column(column) for column in COLUMNS}
        return _readings(values)

    def describe(self) -> Readings:
        """Shapes and units; the frames are (states, channels, rows, columns)."""
        states = (len(self._job.table),)
        keys = {f"{self.name}_file": {"source": "capture file", "dtype": "string", "shape": []}}
        for axis in self._job.table.angles_deg:
            keys[f"{self.name}_{axis}_deg"] = _key(f"axis {axis}, as read back in each state", states, "degree")
        keys |= {f"{self.name}_{column}": _key(column, states, unit) for column, unit in COLUMNS.items()}
        settings = self.rig.require_camera().settings
        frames = _key("counts", (*states, 1, settings.height or 0, settings.width or 0), "count")
        return keys | {f"{self.name}_frames": frames | {"external": "STREAM:", "dtype_numpy": "<u2"}}

    def collect_asset_docs(self, index: int | None = None) -> Iterator[tuple[str, dict[str, Any]]]:
        """Where the frames of the last capture are; each file once."""
        documents, self._documents = self._documents, []
        yield from documents

    def _asset_documents(self, path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
        resource = str(uuid.uuid4())
        with Capture(path) as capture:
            chunk = (1, 1, *capture.stored_shape)
        yield (
            "stream_resource",
            {
                "uid": resource,
                "data_key": f"{self.name}_frames",
                "mimetype": "application/x-hdf5",
                "uri": path.resolve().as_uri().replace("file:///", "file://localhost/"),
                "parameters": {"dataset": "/entry/instrument/detector/data", "swmr": False, "chunk_shape": chunk},
            },
        )
        yield (
            "stream_datum",
            {
                "uid": f"{resource}/0",
                "stream_resource": resource,
                "descriptor": "",
                "indices": {"start": 0, "stop": 1},
                "seq_nums": {"start": 0, "stop": 0},
            },
        )


class Bench:
    """An open rig and its devices; made by `open_bench`."""

    def __init__(self, config: RigConfig, rig: Rig, home: bool) -> None:
        self.config, self.rig, self.home = config, rig, home
        self.turn = threading.Lock()
        self.axes = {name: AxisDevice(name, rig, self.turn) for name in rig.axes}
        self.camera = CameraDevice("camera", rig, self.turn)

    def capture(self, plan: MeasurementPlan, folder: Path | str, name: str = "capture") -> CaptureDevice:
        """A device that takes captures by a plan. Raises PlanRefused."""
        return CaptureDevice(name, self, plan, folder)


@contextmanager
def open_bench(rig_file: Path | str, home: bool = False) -> Iterator[Bench]:
    """The devices of a rig, open until the end of the block.

    Parameters
    ----------
    home : home axes without a reference now; nothing homes unless asked here or by the rig file.
    """
    config = load_rig(rig_file)
    with Rig(config) as rig:
        if (home or config.home_at_start) and (missing := rig.unhomed()):
            rig.home(missing)
        yield Bench(config, rig, home)


def _readings(values: dict[str, Any]) -> Readings:
    now = time.time()
    return {name: {"value": value, "timestamp": now} for name, value in values.items()}


def _key(source: str, shape: tuple[int, ...], units: str) -> dict[str, Any]:
    return {"source": source, "dtype": "array" if shape else "number", "shape": list(shape), "units": units}
