"""One capture from job to sealed file: home, go to the pose, take the states, and seal, also after an error."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.capture.closing import closing_record, keep_end
from acquisition.capture.header import capture_header, now, title_of
from acquisition.capture.identity import devices_of, require_same_devices
from acquisition.capture.job import Job, Result, frame_shape
from acquisition.capture.mosaic_phase import match_mosaic
from acquisition.capture.partial_file import as_partial
from acquisition.capture.plan import ARM, AutoExposure
from acquisition.capture.records import begin_record, end_record
from acquisition.capture.runner import CaptureRunner, TooBright
from acquisition.capture.writer import CaptureWriter
from acquisition.cleanup import run_all
from acquisition.disc import on_disc
from acquisition.errors import AcquisitionError, Stopped, as_run_error
from acquisition.rig.interlocks import LightSoFar, light_so_far
from acquisition.rig.rig import Rig
from acquisition.rig.turns import fold_angles, turns_to, unwind
from acquisition.screen.observer import Mosaic, Observer
from acquisition.stop_request import StopRequest
from processing.arrays import Array
from processing.instrument.applied_effects import changes_at
from processing.reduction.lit_darks import LitDarks, resume_lit_darks
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import Status

#: How often a capture with auto exposure begins again because a state saturated.
DARKER_TRIES = 3


def take(
    job: Job, rig: Rig, path: Path, stop: StopRequest, *, observers: Sequence[Observer] = (), home: bool = False
) -> Result:
    """Take a new capture into `path`; the rig is open and `check_with_devices` has passed.

    Raises AcquisitionError, DeviceError: the run failed; the message names the partial file, which `resume` continues.
    """
    _require_reference(rig, home)
    place_sample(job, rig)
    job = replace(
        job,
        table=unwind(fold_angles(job.table, rig), rig),
        instrument=match_mosaic(job.instrument, rig.require_camera()),
    )
    header = capture_header(job.plan, job.rig, job.instrument, rig)
    begin = begin_record(job, rig, 0)
    writer = CaptureWriter.create(
        path, header, job.table, frame_shape(rig), start_time=now(), begin=begin, clock=rig.clock
    )
    if not job.exposure_known:
        writer.set_exposure(np.full(len(job.table), np.nan))
    return _run(job, rig, writer, range(len(job.table)), stop=stop, observers=observers, earlier=None)


def resume(
    job: Job, rig: Rig, partial: Path, stop: StopRequest, *, observers: Sequence[Observer] = (), home: bool = False
) -> Result:
    """Continue a capture: the first state not done, then the others, as a new segment of it. Raises as `take`.

    Raises Differs: the capture was begun with other devices or settings.
    """
    _require_reference(rig, home)
    place_sample(job, rig)
    job = replace(job, instrument=match_mosaic(job.instrument, rig.require_camera()))
    lights = sum(role != "dark" for role in job.table.role)
    earlier = on_disc(
        f"read {partial}", _history, partial, frame_shape(rig), job.instrument.mosaic, devices_of(rig), lights=lights
    )
    writer = CaptureWriter(on_disc(f"rename {partial}", as_partial, partial), rig.clock)
    pending = [k for k in range(len(job.table)) if k not in earlier.done]
    return _run(job, rig, writer, pending, stop=stop, observers=observers, earlier=earlier)


@dataclass(frozen=True)
class Earlier:
    """State of a capture that is resumed: its states, number of segments, the light in them, its darks."""

    done: set[int]
    segments: int
    light: LightSoFar
    darks: LitDarks


def _history(
    partial: Path,
    shape: tuple[int, int],
    mosaic: Mosaic | None,
    devices: tuple[dict[str, Any], dict[str, Any]],
    *,
    lights: int,
) -> Earlier:
    with Capture(partial) as capture:
        if capture.stored_shape != shape:
            raise AcquisitionError(
                f"{partial} has frames of {capture.stored_shape}, the camera gives {shape}. "
                "Use the camera and the settings of its first run."
            )
        if capture.header.mosaic != mosaic:
            raise AcquisitionError(
                f"{partial} has the mosaic {capture.header.mosaic}, the camera's region now gives {mosaic}. Use the "
                "region of its first run."
            )
        require_same_devices(capture, *devices)
        look, problem = resume_lit_darks(capture, lights)
        if problem is not None:
            raise AcquisitionError(f"{partial}: {problem}. It cannot be resumed: begin the capture again.")
        return Earlier(set(capture.done.tolist()), len(capture.segments), light_so_far(capture), look)


def place_sample(job: Job, rig: Rig) -> None:
    """Have the sample, the optics and the filter of the plan in place."""
    plan = job.plan
    rig.show(
        plan.sample.name or plan.sample.kind,
        plan.wavelength_nm,
        mode=plan.mode,
        instrument=job.instrument,
        omega_deg=plan.omega_deg if ARM in job.rig.axes else None,
    )


def _run(
    job: Job,
    rig: Rig,
    writer: CaptureWriter,
    pending: Sequence[int],
    *,
    stop: StopRequest,
    observers: Sequence[Observer],
    earlier: Earlier | None,
) -> Result:
    watchers = [*observers, *rig.observers()]
    auto = job.plan.exposure_s
    first = pending[0] if pending else 0
    runner = CaptureRunner(
        rig,
        job.table,
        writer,
        job.rig.detector,
        stop=stop,
        observers=watchers,
        continue_after_interlock=job.plan.continue_after_interlock,
        saturation_limit=1 - auto.percentile / 100 if isinstance(auto, AutoExposure) else None,
        mosaic=job.instrument.mosaic is not None,
        lit_darks=None if earlier is None else earlier.darks,
        rows=_rows(job),
        turns={} if earlier is None else turns_to(job.table, rig, first, rig.pose_after_homing(), preferred={}),
    )
    status: Status = "failed"
    failure: BaseException | None = None
    if earlier is not None:
        _begin_segment(job, rig, runner, earlier)
    writer.on_failure = stop.fail
    writer.on_blocked = partial(rig.lose_light, "the disc takes no data: the light is shut until it does")
    try:
        _announce(job, rig, runner, len(pending))
        with stop.failing_here():
            _go_to_start(job, rig, runner, first)
            is_whole = _take_states(job, runner, pending)
        if is_whole:
            status = "complete"
        else:
            status = "aborted"
            _park(rig, runner)
    except (KeyboardInterrupt, Stopped) as interrupt:
        status, failure = "aborted", interrupt
    except Exception as error:  # noqa: BLE001 - every end has its record
        failure = as_run_error(error)
        if failure is not error:
            failure.__cause__ = error
    except BaseException as error:  # noqa: BLE001 - it is raised again once the end has its record
        failure = error
    light = run_all([("shut off the light", _shut(rig))])
    if light is not None:
        runner.warn(f"the light could not be shut off: {light}")
    failed_check = run_all([("judge the frames", runner.checks.judge)])
    if failed_check is not None:
        runner.warn(f"the frames could not be compared: {failed_check}")
    closing, path = _end_segment(runner, rig, status, failure)
    fault = run_all([("tell of the end", partial(observer.run_ended, status, closing)) for observer in watchers])
    if fault is not None and failure is None:
        raise as_run_error(fault)
    if failure is not None:
        failure.add_note(f"States done so far are in {path}. Continue with: acquire --resume {path}")
        raise failure
    return _result(path, status, job, runner)


def _announce(job: Job, rig: Rig, runner: CaptureRunner, pending: int) -> None:
    for text in rig.require_camera().warnings():
        runner.warn(f"the camera is not in a known state: {text}")
    for observer in runner.observers:
        observer.run_started(title_of(job.plan), job.table, pending, job.instrument.mosaic)


def _rows(job: Job) -> Array | None:
    """Rows of the measurement matrix (states, 16) for the mean of a frame; None where angles are not numbers."""
    angles = {axis: job.table.angles_deg[axis] for axis in job.instrument.axes}
    if not angles:
        return None
    return np.asarray(job.instrument.rows(angles, changes_at(job.instrument, angles)).mean(axis=1))


def _take_states(job: Job, runner: CaptureRunner, pending: Sequence[int]) -> bool:
    """Take the states, at an exposure that is found first where the plan says so."""
    auto = job.plan.exposure_s
    if isinstance(auto, AutoExposure) and not job.exposure_known:
        runner.find_exposure(job.instrument, job.plan.sample.kind, auto)
    for _ in range(DARKER_TRIES):
        try:
            return runner.run(pending)
        except TooBright as error:
            # Nothing of a rotation with a saturated state is kept: its states would not have one exposure.
            pending = range(len(job.table))
            runner.start_darker(str(error))
    return runner.run(pending)


def _require_reference(rig: Rig, home: bool) -> None:
    """Refuse axes without a reference, unless homing was asked for, by option or rig file."""
    unhomed = rig.unhomed()
    if unhomed and not (home or rig.config.home_at_start):
        raise AcquisitionError(
            f"no reference position: {', '.join(unhomed)}. Nothing was moved. Check that the way is free, then "
            "home the axes with `acquire home` (or --home)."
        )


def _go_to_start(job: Job, rig: Rig, runner: CaptureRunner, first: int) -> None:
    # A wavelength that the source does not have ends the run before anything turns.
    if rig.source is not None and rig.source.selects_wavelength:
        rig.source.select(job.plan.wavelength_nm)
    unhomed = rig.unhomed()
    if unhomed:
        runner.tell(f"homing {', '.join(unhomed)}")
        with runner.ledger.time("homing"):
            rig.home(unhomed)
    # The arm goes first and alone: the parts on it and the sample can collide.
    runner.go(first, "approach")


def _park(rig: Rig, runner: CaptureRunner) -> None:
    if rig.config.park_deg:
        runner.tell("parking")
        rig.go(rig.config.park_deg, runner.poses_deg)


def _shut(rig: Rig) -> Callable[[], None]:
    def shut() -> None:
        if rig.source is not None:
            rig.source.set_light(False)

    return shut


def _begin_segment(job: Job, rig: Rig, runner: CaptureRunner, earlier: Earlier) -> None:
    """Write the begin record of the new segment into the file."""
    writer = runner.writer
    runner.interlocks.remember(earlier.light)
    writer.segment = earlier.segments
    runner.warn(f"resumed as segment {writer.segment}")
    try:
        writer.add_segment_record(begin_record(job, rig, writer.segment))
    except BaseException:
        writer.abandon()
        raise


def _end_segment(
    runner: CaptureRunner, rig: Rig, status: Status, failure: BaseException | None
) -> tuple[dict[str, Any], Path]:
    """Write what became of the run, and seal the file. Returns the closing record and the file."""
    writer = runner.writer
    end = end_record(runner, rig, writer.segment, status, failure=failure)
    closing = closing_record([], end)
    try:
        writer.settle(in_haste=failure is not None)
        closing = closing_record(writer.segment_records(), end)
        # Half of what is left, so that there is room for the next.
        writer.add_segment_record(end, part=0.5)
        # A run that can go on keeps its partial name, but for the orderly end after one Ctrl-C.
        return closing, writer.seal(status, closing, keep_partial=failure is not None)
    except (AcquisitionError, OSError) as error:
        writer.abandon()
        note = keep_end(writer.path, closing)
        if failure is None:
            error.add_note(note)
            raise
        if str(error) != str(failure):
            failure.add_note(f"the end of the run could not be recorded: {error}")
        failure.add_note(note)
        return closing, writer.path


def _result(path: Path, status: Status, job: Job, runner: CaptureRunner) -> Result:
    done, saturated, off_deg = on_disc(f"read {path}", _read_back, path, dict(job.table.angles_deg))
    ledger, messages = runner.ledger.summary(), tuple(runner.messages.texts)
    return Result(path, status, done, len(job.table), ledger, messages, saturated, off_deg)


def _read_back(path: Path, targets_deg: dict[str, Array]) -> tuple[int, float, float]:
    """States done, largest part of saturated pixels, and largest angle off a target."""
    with Capture(path) as capture:
        saturated = capture.column("saturated_fraction")
        differences = [
            # A part of the states may have been taken some turns away.
            np.abs((capture.angles_deg[axis] - target[capture.done] + 180.0) % 360.0 - 180.0)
            for axis, target in targets_deg.items()
        ]
        return len(capture.done), float(np.max(saturated, initial=0.0)), float(np.max(differences, initial=0.0))
