"""One capture from plan to sealed file: check everything, home, go to the pose, take the states, seal."""

from __future__ import annotations

import datetime
import platform
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.capture_writer import PARTIAL, CaptureWriter, bytes_needed, check_space
from acquisition.checks import (
    Check,
    check_devices,
    check_plan,
    check_table,
    load_instrument,
    refuse_failed,
    standing_pose_deg,
)
from acquisition.cleanup import run_all
from acquisition.errors import AcquisitionError
from acquisition.observer import Observer
from acquisition.plan import ARM, MeasurementPlan
from acquisition.rig import Rig
from acquisition.rig_config import RigConfig
from acquisition.runner import CaptureRunner
from acquisition.stop_request import StopRequest
from drivers.errors import DeviceError
from processing.capture import Capture
from processing.capture_schema import CaptureHeader, Status
from processing.instrument import InstrumentModel
from processing.states import StateTable
from processing.yaml_file import dump_yaml, parse_yaml


@dataclass(frozen=True)
class Job:
    """A capture that passed the checks that need no device."""

    plan: MeasurementPlan
    rig: RigConfig
    instrument: InstrumentModel
    table: StateTable
    checks: tuple[Check, ...]
    seed: int | None = None


@dataclass(frozen=True)
class Result:
    """What became of a capture."""

    path: Path
    status: Status
    states_done: int
    states: int
    ledger: dict[str, float] = field(default_factory=dict)
    messages: tuple[str, ...] = ()
    saturated_fraction: float = 0.0
    worst_angle_deg: float = 0.0


def prepare(plan: MeasurementPlan, rig: RigConfig, exposure_s: float | None = None) -> Job:
    """Check a plan against a rig file; touches no device.

    Parameters
    ----------
    exposure_s : exposure where the plan leaves it to be found; its start value otherwise.

    Raises
    ------
    PlanRefused
        With everything that is wrong.
    """
    checks = check_plan(plan, rig)
    refuse_failed(checks)
    instrument = load_instrument(plan, rig)
    chosen = exposure_s or (plan.exposure_s if isinstance(plan.exposure_s, float) else plan.exposure_s.start_s)
    table = plan.state_table(standing_pose_deg(plan, rig), chosen)
    checks += check_table(table, rig, instrument)
    refuse_failed(checks)
    seed = rig.simulator.seed if rig.simulator else None
    return Job(plan, rig, instrument, table, tuple(checks), seed)


def check_with_devices(job: Job, rig: Rig, folder: Path) -> list[Check]:
    """Limits, door, exposure and disc, as the devices have them; nothing moves."""
    checks = check_devices(job.table, rig)
    exposure_s = float(job.table.exposure_s[0])
    settings = rig.set_exposure(exposure_s, job.plan.repeats)
    read_back_s = settings.exposure_s or exposure_s
    close = abs(read_back_s - exposure_s) <= max(0.02 * exposure_s, 5e-5)
    checks.append(Check("camera exposure", close, f"asked {exposure_s:g} s, read back {read_back_s:g} s"))
    rows, columns = _frame_shape(rig)
    needed = bytes_needed(len(job.table), 1, (rows, columns))
    try:
        check_space(_existing(folder), needed)
        checks.append(Check("disc", True, f"{needed / 1e6:.0f} MB in {folder}"))
    except AcquisitionError as error:
        checks.append(Check("disc", False, str(error)))
    return checks


def take(
    job: Job,
    rig: Rig,
    path: Path,
    stop: StopRequest,
    observers: Sequence[Observer] = (),
    home: bool = False,
) -> Result:
    """Take a new capture into `path`; the rig is open and `check_with_devices` has passed.

    Raises
    ------
    AcquisitionError, DeviceError
        The run failed; the message names the partial file, which `resume` goes on with.
    """
    _require_reference(rig, home)
    place_sample(job, rig)
    header = _header(job, rig)
    writer = CaptureWriter.create(path, header, job.table, _frame_shape(rig), _now())
    return _run(job, rig, writer, range(len(job.table)), stop, observers)


def resume(
    job: Job, rig: Rig, partial: Path, stop: StopRequest, observers: Sequence[Observer] = (), home: bool = False
) -> Result:
    """Go on with a capture: the first state not done, then the others. Raises as `take`."""
    _require_reference(rig, home)
    place_sample(job, rig)
    with Capture(partial) as capture:
        done = set(capture.done.tolist())
        if capture.frame_shape != _frame_shape(rig):
            raise AcquisitionError(
                f"{partial} has frames of {capture.frame_shape}, the camera gives {_frame_shape(rig)}. "
                "Go on with the camera and the settings that began it."
            )
    if not partial.name.endswith(PARTIAL):
        partial = partial.rename(partial.with_name(partial.name + PARTIAL))
    writer = CaptureWriter.reopen(partial)
    pending = [k for k in range(len(job.table)) if k not in done]
    return _run(job, rig, writer, pending, stop, observers)


def job_of(path: Path, rig: RigConfig | None = None) -> Job:
    """The job that a partial, aborted or failed capture belongs to.

    Parameters
    ----------
    rig : rig to use instead of the one stored in the file, for instance after a port has changed.

    Raises
    ------
    CaptureError, AcquisitionError
        Not a capture, or complete already.
    """
    with Capture(path) as capture:
        if capture.status == "complete":
            raise AcquisitionError(f"{path} is complete; there is nothing to go on with.")
        header, exposure_s = capture.header, float(capture.planned_column("exposure_s")[0])
    plan = parse_yaml(header.plan_yaml, MeasurementPlan, source=f"{path}: plan")
    stored = parse_yaml(header.rig_yaml, RigConfig, source=f"{path}: rig")
    return prepare(plan, rig or stored, exposure_s)


def place_sample(job: Job, rig: Rig) -> None:
    """On a simulated rig, do what the operator does: sample, optics and filter."""
    simulation, config = rig.simulation, job.rig.simulator
    if simulation is None or config is None:
        return
    truth = config.truth.get(job.plan.mode)
    instrument = InstrumentModel.load(truth) if truth else job.instrument
    simulation.prepare(job.plan.sample.name or job.plan.sample.kind, instrument, job.plan.wavelength_nm)


class Announcer(Observer):
    """Tells the simulated bench to which state the next exposure belongs."""

    def __init__(self, announce: Callable[[int, int], None]) -> None:
        self._announce = announce

    def exposing(self, state: int, retake: int) -> None:
        self._announce(state, retake)


def _run(
    job: Job,
    rig: Rig,
    writer: CaptureWriter,
    pending: Sequence[int],
    stop: StopRequest,
    observers: Sequence[Observer],
) -> Result:
    watchers = list(observers)
    if rig.simulation is not None:
        watchers.append(Announcer(rig.simulation.announce))
    runner = CaptureRunner(rig, job.table, writer, job.rig.detector, stop, watchers, job.plan.continue_after_interlock)
    status: Status = "failed"
    failure: BaseException | None = None
    for observer in watchers:
        observer.run_started(_title(job), job.table, len(pending))
    try:
        _go_to_start(job, rig, watchers)
        if runner.run(pending):
            status = "complete"
        else:
            status = "aborted"
            _park(rig, watchers)
    except KeyboardInterrupt as interrupt:
        status, failure = "aborted", interrupt
    except (AcquisitionError, DeviceError) as error:
        failure = error
    except BaseException:
        writer.abandon()
        raise
    finally:
        light = run_all([("shut off the light", _shut(rig))])
        if light is not None:
            runner.warn(f"the light could not be shut off: {light}")
    closing = _closing(runner, rig, status, failure)
    # A run that can go on keeps its partial name, but for the orderly end after one Ctrl-C.
    path = writer.seal(status, closing, keep_partial=failure is not None)
    for observer in watchers:
        observer.run_ended(status, closing)
    if failure is not None:
        failure.add_note(f"States done so far are in {path}. Go on with: acquire --resume {path}")
        raise failure
    return _result(path, status, job, runner)


def _require_reference(rig: Rig, home: bool) -> None:
    """Refuse axes without a reference, unless homing was asked for, by option or rig file."""
    unhomed = rig.unhomed()
    if unhomed and not (home or rig.config.home_at_start):
        raise AcquisitionError(
            f"no reference position: {', '.join(unhomed)}. Nothing was moved. Look whether the way is free, then "
            "home the axes with `acquire home` (or --home)."
        )


def _go_to_start(job: Job, rig: Rig, observers: Sequence[Observer]) -> None:
    unhomed = rig.unhomed()
    if unhomed:
        for observer in observers:
            observer.activity(f"homing {', '.join(unhomed)}")
        rig.home(unhomed)
    first = {axis: float(column[0]) for axis, column in job.table.angles_deg.items()}
    # The arm goes first and alone: what stands on it and the sample are what it can hit.
    for axes in ([ARM], [axis for axis in first if axis != ARM]):
        targets = {axis: first[axis] for axis in axes if axis in first}
        for observer in observers:
            observer.activity("moving " + ", ".join(f"{axis} to {angle:g}" for axis, angle in targets.items()))
        rig.move(targets)


def _park(rig: Rig, observers: Sequence[Observer]) -> None:
    if rig.config.park_deg:
        for observer in observers:
            observer.activity("parking")
        rig.move(rig.config.park_deg)


def _shut(rig: Rig) -> Callable[[], None]:
    def shut() -> None:
        if rig.source is not None:
            rig.source.set_light(False)

    return shut


def _closing(runner: CaptureRunner, rig: Rig, status: str, failure: BaseException | None) -> dict[str, Any]:
    closing: dict[str, Any] = {
        "end_time": _now(),
        "status": status,
        "ledger": runner.ledger.summary(),
        "messages": runner.messages.texts,
        "messages_dropped": runner.messages.dropped,
        "interlocks": runner.interlocks.events,
    }
    if failure is not None:
        closing["failure"] = str(failure) or type(failure).__name__
    try:
        closing["stream"] = asdict(rig.require_camera().statistics())
    except DeviceError as error:
        closing["stream"] = {"failure": str(error)}
    return closing


def _result(path: Path, status: Status, job: Job, runner: CaptureRunner) -> Result:
    with Capture(path) as capture:
        saturated = capture.column("saturated_fraction")
        done = capture.done
        off = [np.abs(capture.angles_deg[axis] - target[done]) for axis, target in job.table.angles_deg.items()]
    worst = float(np.max(saturated, initial=0.0))
    worst_angle = float(np.max(off, initial=0.0))
    return Result(
        path,
        status,
        len(done),
        len(job.table),
        runner.ledger.summary(),
        tuple(runner.messages.texts),
        worst,
        worst_angle,
    )


def _header(job: Job, rig: Rig) -> CaptureHeader:
    camera = rig.require_camera()
    plan = job.plan
    mosaic = job.instrument.mosaic
    return CaptureHeader(
        title=_title(job),
        simulated=job.rig.simulated,
        mode=plan.mode,
        wavelength_nm=plan.wavelength_nm,
        omega_deg=plan.omega_deg,
        illumination=_illumination(job),
        sample=plan.sample,
        detector=job.rig.detector.model_copy(update={"bits": camera.bits}),
        channels=("mosaic",) if mosaic else tuple(c.name for c in job.instrument.channels),
        mosaic=mosaic,
        instrument_yaml=dump_yaml(job.instrument),
        plan_yaml=dump_yaml(plan),
        rig_yaml=dump_yaml(job.rig),
        camera_settings_json=camera.settings.model_dump_json(),
        devices_json=_json(rig.describe()),
        versions=versions(),
        seed=job.seed,
    )


def _illumination(job: Job) -> str | None:
    """Horizontal or vertical, where the generator stands still and makes one of the two."""
    if any(element.axis for element in job.instrument.generator):
        return None
    s = job.instrument.generator_states({"none": [0.0]})[0]
    if abs(s[1]) < 0.99 * s[0]:
        return None
    return "horizontal" if s[1] > 0 else "vertical"


def versions() -> dict[str, str]:
    """Versions of what made the file."""
    from importlib.metadata import version

    import h5py

    names = ("umov", "numpy", "h5py", "pyserial", "pydantic")
    found = {name: version(name) for name in names}
    return found | {"hdf5": h5py.version.hdf5_version, "python": platform.python_version()}


def default_name(job: Job) -> str:
    """File name of a capture: date, time, sample, mode, wavelength, Omega."""
    plan = job.plan
    sample = re.sub(r"[^A-Za-z0-9]+", "_", plan.sample.name or plan.sample.kind).strip("_")
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    return f"{stamp}_{sample}_{plan.mode}_{plan.wavelength_nm:g}nm_omega{plan.omega_deg:g}.h5"


def _title(job: Job) -> str:
    plan = job.plan
    sample = plan.sample.name or plan.sample.kind
    return plan.title or f"{sample}, {plan.mode}, {plan.wavelength_nm:g} nm, Omega {plan.omega_deg:g} deg"


def _frame_shape(rig: Rig) -> tuple[int, int]:
    settings = rig.require_camera().settings
    if settings.height is None or settings.width is None:
        raise AcquisitionError("the camera does not tell the size of its frames")
    return settings.height, settings.width


def _existing(folder: Path) -> Path:
    while not folder.exists():
        folder = folder.parent
    return folder


def _now() -> str:
    return datetime.datetime.now().astimezone().isoformat(timespec="milliseconds")


def _json(value: Any) -> str:
    import json

    return json.dumps(value, default=str)
