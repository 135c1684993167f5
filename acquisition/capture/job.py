"""A capture as a job: plan, rig, instrument and states that belong together and have been checked."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.capture.checks import (
    CheckResult,
    ReadInstrument,
    check_devices,
    check_plan,
    check_table,
    load_instrument,
    refuse_failed,
    standing_pose_deg,
)
from acquisition.capture.identity import require_same
from acquisition.capture.mosaic_phase import match_mosaic
from acquisition.capture.partial_file import bytes_needed, check_space
from acquisition.capture.plan import AutoExposure, MeasurementPlan
from acquisition.disc import on_disc
from acquisition.errors import AcquisitionError
from acquisition.rig.config import RigConfig
from acquisition.rig.rig import Rig
from acquisition.rig.turns import fold_angles
from processing.instrument.model import InstrumentModel
from processing.instrument.states import StateTable
from processing.storage.captures.capture import Capture
from processing.storage.captures.frame_layout import Beams
from processing.storage.captures.schema import Status
from processing.yaml_file import parse_yaml


@dataclass(frozen=True)
class Job:
    """A capture that passed the checks that need no device; `first` is the state that is taken first."""

    plan: MeasurementPlan
    rig: RigConfig
    instrument: InstrumentModel
    table: StateTable
    checks: tuple[CheckResult, ...]
    exposure_known: bool = True
    first: int = 0


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


def prepare(plan: MeasurementPlan, rig: RigConfig, read: ReadInstrument = InstrumentModel.load) -> Job:
    """Check a plan against a rig file; touches no device.

    Where the plan leaves the exposure to be found, the table holds the one that the search starts with. `read` reads
    the instrument's file; a caller that prepares many plans reads it once. Raises PlanRefused with everything that is
    wrong.
    """
    checks = check_plan(plan, rig)
    refuse_failed(checks)
    instrument = load_instrument(plan, rig, read)
    exposure_s = plan.exposure_s if isinstance(plan.exposure_s, float) else plan.exposure_s.start_s
    table = plan.state_table(standing_pose_deg(plan, rig), exposure_s, rig.named_states())
    checks += check_table(table, rig, instrument)
    refuse_failed(checks)
    return Job(plan, rig, instrument, table, tuple(checks), not isinstance(plan.exposure_s, AutoExposure))


def check_with_devices(
    job: Job, rig: Rig, folder: Path, here_deg: Mapping[str, float] | None = None
) -> list[CheckResult]:
    """Limits, door, exposure and disc, as the devices have them; nothing moves.

    Parameters
    ----------
    here_deg : where the axes will stand before the capture; None for where they stand once they are homed.
    """
    checks = check_devices(fold_angles(job.table, rig), rig, job.first, here_deg)
    for exposure_s in np.unique(job.table.exposure_s)[::-1]:
        settings = rig.set_exposure(float(exposure_s), job.plan.repeats)
        read_back_s = settings.exposure_s or float(exposure_s)
        close = abs(read_back_s - exposure_s) <= max(0.02 * exposure_s, 5e-5)
        checks.append(CheckResult("camera exposure", close, f"asked {exposure_s:g} s, read back {read_back_s:g} s"))
    mosaic = _check_mosaic(job.instrument, rig)
    if job.instrument.mosaic is not None or not mosaic.passed:
        checks.append(mosaic)
    rows, columns = frame_shape(rig)
    if job.instrument.beams is not None:
        checks.append(_check_beams(job.instrument.beams, rows, columns))
    needed = bytes_needed(len(job.table), 1, (rows, columns))
    return [*checks, check_disc("disc", folder, needed)]


def check_disc(title: str, folder: Path, needed: int) -> CheckResult:
    """Whether a folder has room for so many bytes."""
    try:
        on_disc(f"look at {folder}", _check_space_in, folder, needed)
    except AcquisitionError as error:
        return CheckResult(title, False, str(error))
    return CheckResult(title, True, f"{needed / 1e6:.0f} MB in {folder}")


def _check_space_in(folder: Path, needed: int) -> None:
    """Check the folder, or the nearest one above it that is there."""
    while not folder.exists():
        folder = folder.parent
    check_space(folder, needed)


def _check_mosaic(instrument: InstrumentModel, rig: Rig) -> CheckResult:
    try:
        mosaic = match_mosaic(instrument, rig.require_camera()).mosaic or ()
    except AcquisitionError as error:
        return CheckResult("mosaic", False, str(error))
    return CheckResult("mosaic", True, "from the top left: " + " / ".join(" ".join(line) for line in mosaic))


def _check_beams(beams: tuple[str, ...], rows: int, columns: int) -> CheckResult:
    try:
        height, width = Beams(beams).shape((rows, columns))
    except ValueError as error:
        return CheckResult("beams", False, f"{error}. Change the camera's width")
    return CheckResult("beams", True, f"from the left: {', '.join(beams)}, {width} x {height} pixels each")


def job_of(path: Path, rig: RigConfig | None = None, plan: MeasurementPlan | None = None) -> Job:
    """The job that a partial, aborted or failed capture belongs to.

    Parameters
    ----------
    rig : the rig to go on with instead of the one stored in the file; only where its devices are plugged in may differ.
    plan : the plan of the capture; None for the one in its file.

    Raises
    ------
    CaptureError, AcquisitionError
        Not a capture, or complete already.
    Differs
        Begun with another plan, rig, instrument or program.
    """
    with Capture(path) as capture:
        if capture.status == "complete":
            raise AcquisitionError(f"{path} is complete; there is nothing to resume.")
        exposure_s = capture.planned_column("exposure_s")
        targets = capture.planned_targets_deg()
        done = set(capture.done.tolist())
        plan = plan or stored_plan(capture)
        job = prepare(plan, rig or stored_rig(capture))
        require_same(capture, plan, job.rig, job.instrument)
    # The targets as they were: an endless axis may have begun some turns away from zero.
    _require_same_targets(path, job, targets)
    if np.any(exposure_s <= 0):
        raise AcquisitionError(f"{path} is damaged: an exposure of {np.nanmin(exposure_s):g} s is planned in it.")
    table = replace(job.table, angles_deg=targets)
    refuse_failed(check_table(table, job.rig, job.instrument))
    job = replace(job, first=next((state for state in range(len(table)) if state not in done), 0))
    is_finite = np.isfinite(exposure_s)
    if not is_finite.any():
        return replace(job, table=table)
    # The exposure of a state whose record was damaged: as the plan has it to that of the others.
    factor = float(np.median(exposure_s[is_finite] / table.exposure_s[is_finite]))
    exposure_s = np.where(is_finite, exposure_s, factor * table.exposure_s)
    return replace(job, table=replace(table, exposure_s=exposure_s), exposure_known=True)


def _require_same_targets(path: Path, job: Job, targets: Mapping[str, NDArray[np.float64]]) -> None:
    """Refuse targets that are not those of the plan, but for turns, or half turns where the rig folds them."""
    for axis, planned in job.table.angles_deg.items():
        stored, period = targets.get(axis), float(job.rig.fold_deg.get(axis, 360))
        if stored is None or stored.shape != planned.shape:
            raise AcquisitionError(f"{path} is damaged: it has not the targets of axis {axis} that its plan asks for.")
        difference = np.abs((stored - planned + period / 2) % period - period / 2)
        if not np.all(difference < 1e-6):
            state = int(np.argmin(difference < 1e-6))
            raise AcquisitionError(
                f"{path} is damaged: state {state} has axis {axis} at {stored[state]:g} deg, its plan at "
                f"{planned[state]:g} deg. Nothing was moved. Begin the capture again: acquire --resume FILE --as-new"
            )


def stored_plan(capture: Capture) -> MeasurementPlan:
    """The plan that a capture was made from. Raises ConfigError."""
    return parse_yaml(capture.header.plan_yaml, MeasurementPlan, source=f"{capture.path}: plan")


def stored_rig(capture: Capture) -> RigConfig:
    """The rig that a capture was begun with. Raises ConfigError."""
    return parse_yaml(capture.header.rig_yaml, RigConfig, source=f"{capture.path}: rig")


def frame_shape(rig: Rig) -> tuple[int, int]:
    """(rows, columns) of the frames that the camera is set to."""
    settings = rig.require_camera().settings
    if settings.height is None or settings.width is None:
        raise AcquisitionError("the camera does not report the size of its frames")
    return settings.height, settings.width
