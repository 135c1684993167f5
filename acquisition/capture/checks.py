"""Everything that can be known to be wrong before anything moves."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from acquisition.capture.plan import ARM, AutoExposure, MeasurementPlan
from acquisition.errors import PlanRefused
from acquisition.rig.config import RigConfig
from acquisition.rig.rig import Rig
from acquisition.rig.turns import add_turns, states_deg, turns_to
from acquisition.rig.way import find_obstacle, find_way
from drivers.axis_types import NO_LIMIT_DEG, Limits
from drivers.errors import LimitError
from processing.doors import one_line
from processing.instrument.applied_effects import changes_at
from processing.instrument.determined_basis import determined_basis
from processing.instrument.model import InstrumentModel, WavelengthError, rank
from processing.instrument.states import StateTable
from processing.yaml_file import ConfigError

#: Reads an instrument file.
ReadInstrument: TypeAlias = Callable[[Path], InstrumentModel]


@dataclass(frozen=True)
class CheckResult:
    """The result of one check: its title, whether it passed, and the detail in words."""

    title: str
    passed: bool
    detail: str


def refuse_failed(checks: Sequence[CheckResult]) -> None:
    """Raise PlanRefused with every check that failed, before anything has moved."""
    failures = [f"{check.title}: {check.detail}" for check in checks if not check.passed]
    if failures:
        raise PlanRefused(failures)


def standing_pose_deg(plan: MeasurementPlan, rig: RigConfig) -> dict[str, float]:
    """Angles of the axes that stand still during the capture: the arm and the mode's own pose.

    Raises PlanRefused: the mode's pose is not given at the plan's wavelength.
    """
    pose = {}
    for axis, angle in rig.modes[plan.mode].pose_deg.items():
        if isinstance(angle, dict):
            match = [v for k, v in angle.items() if abs(k - plan.wavelength_nm) < 0.5]
            if not match:
                listing = ", ".join(f"{k:g}" for k in angle)
                raise PlanRefused([f"pose of {axis}: the rig file has {listing} nm, not {plan.wavelength_nm:g} nm"])
            pose[axis] = match[0]
        else:
            pose[axis] = angle
    if ARM in rig.axes:
        pose[ARM] = plan.omega_deg
    return pose


def check_plan(plan: MeasurementPlan, rig: RigConfig) -> list[CheckResult]:
    """Checks that need only the files: mode, wavelength, axes, exposure, forbidden poses."""
    checks = [_member("mode", plan.mode, list(rig.modes))]
    wavelengths = [f"{w:g}" for w in rig.wavelengths_nm]
    checks.append(_member("wavelength_nm", f"{plan.wavelength_nm:g}", wavelengths))
    if rig.sample_names is not None:
        checks.append(_member("sample", plan.sample.name or plan.sample.kind, rig.sample_names))
    try:
        turning = plan.states.angles_deg(rig.named_states())
    except ConfigError as error:
        return [*checks, CheckResult("states", False, str(error))]
    missing = sorted(set(turning) - set(rig.axes))
    checks.append(
        CheckResult(
            "axes", not missing, f"the rig has no axis {', '.join(missing)}" if missing else ", ".join(rig.axes)
        )
    )
    if plan.sample.kind == "air" and abs(plan.omega_deg - 180) > 0.5:
        checks.append(CheckResult("sample", False, f"air needs omega 180 (straight through), not {plan.omega_deg:g}"))
    if plan.darks and rig.source is None:
        text = f"{plan.darks} dark states, but the rig has no source that shuts off the light. "
        checks.append(CheckResult("darks", False, text + "Set darks to 0, or give the rig `source: {kind: manual}`"))
    low, high = rig.exposure_s
    if not isinstance(plan.exposure_s, AutoExposure):
        longest = plan.exposure_s * max(plan.bracket)
        fits = low <= plan.exposure_s * min(plan.bracket) and longest <= high
        checks.append(CheckResult("exposure", fits, f"{plan.exposure_s:g} s; the rig allows {low:g} to {high:g} s"))
    return checks


def check_table(table: StateTable, rig: RigConfig, instrument: InstrumentModel) -> list[CheckResult]:
    """Forbidden poses of every state and step, and whether the states determine a Mueller matrix."""
    for axis, column in table.angles_deg.items():
        if not np.all(np.abs(column) < NO_LIMIT_DEG):
            text = f"{column[np.argmin(np.abs(column) < NO_LIMIT_DEG)]:g} deg; no controller counts so far"
            return [CheckResult(f"angles of {axis}", False, text)]
        # The limits of the open controller decide whether a folded target is inside.
        ends, unit = rig.axes[axis].limits_deg, rig.axes[axis].unit
        if ends is None or axis in rig.fold_deg:
            continue
        limits = Limits(*ends)
        beyond = [target for target in column.tolist() if target not in limits]
        if beyond:
            allowed = f"the limits are {limits} {unit} (limits_deg of the rig file)"
            text = f"{beyond[0]:g} {unit}; {allowed}. Change the plan"
            return [CheckResult(f"limits of {axis}", False, text + _fold_hint(axis, rig))]
    checks = _free_ways(rig, states_deg(table))
    lacking = [axis for axis in instrument.axes if axis not in table.angles_deg]
    if lacking:
        text = f"instrument {instrument.name!r} turns with {', '.join(lacking)}, the plan does not"
        return [*checks, CheckResult("instrument", False, text)]
    volts = [a for a, column in table.angles_deg.items() if rig.axes[a].unit == "V" and np.ptp(column) > 0]
    if ignored := sorted(set(volts) - set(instrument.axes)):
        text = f"instrument {instrument.name!r} does not depend on the voltage of {', '.join(ignored)}, which changes"
        return [*checks, CheckResult("instrument", False, f"{text}. Give its W in the instrument file (`measured`)")]
    if len(instrument.channels) > 1 and instrument.mosaic is None and instrument.beams is None:
        text = f"{len(instrument.channels)} channels on one camera: the instrument file says by `beams` where they lie"
        return [*checks, CheckResult("instrument", False, text)]
    light = [k for k, role in enumerate(table.role) if role != "dark"]
    angles = {axis: table.angles_deg[axis][light] for axis in instrument.axes}
    # A mosaic before which nothing turns measures one linear Stokes vector.
    if angles and (instrument.mosaic is None or any(np.ptp(column_deg) > 0 for column_deg in angles.values())):
        w = instrument.rows(angles, changes_at(instrument, angles))
        basis = determined_basis(instrument)
        r, full_rank = rank(w), basis.shape[1]
        size = np.linalg.svd(w.reshape(-1, 16) @ basis, compute_uv=False)
        condition = size[0] / size[-1] if r == full_rank else np.inf
        text = f"rank {r} of {full_rank}, condition number {condition:.2f}"
        if r < full_rank:
            quantity = "a Mueller matrix" if full_rank == 16 else "all that this instrument can"
            text += f": these states do not determine {quantity}. Change states, step_deg or ratio"
        checks.append(CheckResult("state table", r == full_rank, text))
    return checks


def _free_ways(rig: RigConfig, poses: Sequence[Mapping[str, float]]) -> list[CheckResult]:
    """From each state to the next, and from each to where a run that is stopped parks."""
    before: Mapping[str, float] = poses[0]
    for k, pose in enumerate(poses):
        obstacle = find_obstacle(rig, before, pose)
        if obstacle is not None:
            return [CheckResult("poses", False, f"state {k} meets {obstacle}")]
        before = pose
    solids = f", {len(rig.solids.parts)} solids" if rig.solids else ""
    checks = [CheckResult("poses", True, f"{len(poses)} states outside {len(rig.forbidden)} forbidden ranges{solids}")]
    for k, pose in enumerate(poses if rig.park_deg else ()):
        obstacle = find_obstacle(rig, pose, {**pose, **rig.park_deg}, rig.park_deg)
        if obstacle is not None:
            return [*checks, CheckResult("way to the park pose", False, f"from state {k} it meets {obstacle}")]
    return checks


def load_instrument(plan: MeasurementPlan, rig: RigConfig, read: ReadInstrument) -> InstrumentModel:
    """The declared instrument of the plan's mode at its wavelength. Raises ConfigError, PlanRefused."""
    file = rig.modes[plan.mode].instrument
    if not os.path.exists(file):
        raise ConfigError(
            f"modes.{plan.mode}.instrument of the rig file: there is no file {one_line(os.path.normpath(file))}. "
            "A relative path counts from the folder of the rig file: correct it where that was copied elsewhere."
        )
    try:
        return read(file).at(plan.wavelength_nm)
    except WavelengthError as error:
        raise PlanRefused([str(error)]) from error


def check_devices(
    table: StateTable, rig: Rig, state: int = 0, here_deg: Mapping[str, float] | None = None
) -> list[CheckResult]:
    """Every target against the limits of the controllers, and the way to the state taken first; nothing moves.

    Parameters
    ----------
    here_deg : where the axes will stand; None for where they stand once those without a reference are homed.
    """
    checks = []
    for axis, column in table.angles_deg.items():
        try:
            for target in column:
                rig.axes[axis].check(float(target))
        except LimitError as error:
            checks.append(CheckResult(f"limits of {axis}", False, str(error) + _fold_hint(axis, rig.config)))
        else:
            ends = f"{column.min():g} to {column.max():g} {rig.config.axes[axis].unit}"
            checks.append(CheckResult(f"limits of {axis}", True, ends))
    checks.append(_check_first_move(table, rig, state, rig.pose_after_homing() if here_deg is None else here_deg))
    checks += _check_park(rig)
    if rig.source is not None and rig.source.interlock_open():
        checks.append(CheckResult("door", False, "the interlock circuit of the source is open; close it"))
    return checks


def _check_first_move(table: StateTable, rig: Rig, state: int, here_deg: Mapping[str, float]) -> CheckResult:
    poses = states_deg(add_turns(table, turns_to(table, rig, state, here_deg, preferred={})))
    if find_way(rig.config, here_deg, poses[state], poses, limits=rig.limits, first=ARM) is None:
        obstacle = find_obstacle(rig.config, here_deg, {**here_deg, **poses[state]}, poses[state], limits=rig.limits)
        return CheckResult("first move", False, f"to state {state} it meets {obstacle}, and there is no way round it")
    return CheckResult("first move", True, f"free to state {state}")


def _check_park(rig: Rig) -> list[CheckResult]:
    failures = []
    for name, angle in rig.config.park_deg.items():
        try:
            rig.axes[name].check(angle)
        except LimitError as error:
            failures.append(CheckResult(f"park_deg of {name}", False, str(error)))
    return failures


def _fold_hint(axis: str, rig: RigConfig) -> str:
    if axis == ARM or axis in rig.fold_deg or rig.axes[axis].unit != "deg":
        return ""
    return (
        f"; `fold_deg: {{{axis}: 180}}` there takes the same state half a turn away, as polarizers and retarders allow"
    )


def _member(title: str, value: str, choices: list[str]) -> CheckResult:
    is_listed = value in choices
    return CheckResult(title, is_listed, value if is_listed else f"{value!r} is not one of {', '.join(choices)}")
