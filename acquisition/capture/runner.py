"""Takes the states of one capture: move, settle, expose; while the next move runs, fetch and write.

The next move starts as soon as the light of a state has been collected; its frame arrives, and the state before is
written, while the axes turn. A frame that did not arrive whole puts its state back into the queue.
"""

import logging
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from acquisition.capture.auto_exposure import find_exposure
from acquisition.capture.closing import Messages
from acquisition.capture.frame_checks import FrameChecks
from acquisition.capture.plan import ARM, AutoExposure
from acquisition.capture.time_ledger import Entry, TimeLedger
from acquisition.capture.wall_clock import WallClock
from acquisition.capture.writer import CaptureWriter, StateRecord
from acquisition.errors import RunFailed
from acquisition.rig.interlocks import Interlocks
from acquisition.rig.rig import Rig
from acquisition.rig.turns import add_turns, states_deg
from acquisition.screen.observer import Observer
from acquisition.stop_request import StopRequest
from drivers.camera import CameraSettings, Exposure
from drivers.errors import FrameLost
from drivers.motion import Motion, Position
from processing.arrays import Array
from processing.instrument.model import InstrumentModel
from processing.instrument.states import StateTable
from processing.reduction.lit_darks import LitDarks
from processing.storage.captures.schema import Detector

log = logging.getLogger(__name__)

#: Factor on the exposure after a saturated state.
DARKER = 0.6


class TooBright(RunFailed):
    """A state saturated at an exposure that was found automatically: begin again with a shorter one."""


@dataclass
class _Exposed:
    """A state whose light has been collected and whose frame is still on its way."""

    state: int
    exposure: Exposure
    positions: dict[str, Position]
    retake: int
    exposure_s: float
    temperature_c: float
    clock_ahead_s: float
    settings: CameraSettings


class CaptureRunner:
    """Runs the states that are not done yet and hands them to the writer.

    Parameters
    ----------
    rig : open and homed.
    table : rows of the capture.
    writer : open partial file.
    detector : for the black level and full scale of the statistics.
    observers : receive every event.
    saturation_limit : fraction of saturated pixels from which a state raises TooBright; None never.
    mosaic : True for a polarization sensor.
    lit_darks : comparison of darks and lights that has seen the states of earlier runs; None for a new one.
    rows : of the measurement matrix (states, 16) for the mean of a frame; None where that is not known.
    turns : whole turns that the axes add to the angles of `table`, where they reach its states only so.
    """

    def __init__(
        self,
        rig: Rig,
        table: StateTable,
        writer: CaptureWriter,
        detector: Detector,
        *,
        stop: StopRequest,
        observers: Sequence[Observer] = (),
        continue_after_interlock: bool = False,
        saturation_limit: float | None = None,
        mosaic: bool = False,
        lit_darks: LitDarks | None = None,
        turns: Mapping[str, int] | None = None,
        rows: Array | None = None,
    ) -> None:
        self.rig, self.table = rig, table
        self.writer = writer
        self.detector = detector
        self.stop = stop
        self.observers = observers
        self.ledger = TimeLedger(rig.clock)
        self.messages = Messages()
        self.interlocks = Interlocks(rig, self.warn, continue_after_interlock)
        self.poses_deg = states_deg(add_turns(table, turns or {}))
        self._pose_deg: dict[str, float] = {}
        self._last_state: int | None = None
        self._light: bool | None = None
        self._light_losses = rig.light_losses()
        self._retakes: dict[int, int] = {}
        self._pending: deque[int] = deque()
        self._saturation_limit = saturation_limit
        lights = sum(role != "dark" for role in table.role)
        lit_darks = lit_darks or LitDarks(detector.black_level_counts, mosaic=mosaic, lights=lights)
        self.checks = FrameChecks(detector.black_level_counts, rows, lit_darks, self.warn, before=rig.last_frame)
        self._wall_clock = WallClock()
        self._rested: dict[str, Position] = {}

    def run(self, pending: Iterable[int]) -> bool:
        """Take these states; True if all are done, False if a stop was asked for.

        Raises
        ------
        RunFailed
            A state could not be taken in the allowed number of tries, or an interlock ended the run.
        DeviceError, AcquisitionError
            A device or the disc failed; every axis has been sent a stop.
        """
        self._pending = deque(pending)
        self._pose_deg.clear()
        self._last_state = None
        self._rested.clear()
        self._retakes.clear()
        exposed: _Exposed | None = None
        try:
            while self._pending and not self.stop.requested:
                state = self._pending.popleft()
                exposed = self._take(state, exposed)
                if exposed is not None and not self._pending:
                    # The last state has nothing to overlap with; a lost frame refills the queue.
                    self._collect(exposed)
                    exposed = None
            if exposed is not None:
                self._collect(exposed)
        except TooBright:
            self.rig.rest()
            raise
        except BaseException as error:
            failure = self.rig.stop()
            if failure is not None:
                error.add_note(f"stopping the axes failed too: {failure}")
            raise
        return not self._pending

    def tell(self, text: str) -> None:
        """Report the present activity of the rig to the observers."""
        for observer in self.observers:
            observer.activity(text)

    def go(self, state: int, why: Entry) -> None:
        """Go to the pose of a state, from wherever the axes stand, by an allowed way; `why` is the ledger's entry.

        Raises AcquisitionError: there is no allowed way.
        """
        targets = self.poses_deg[state]
        self.tell("moving " + ", ".join(f"{axis} to {angle:g}" for axis, angle in targets.items()))
        with self.ledger.time(why):
            self.rig.go(targets, self.poses_deg, ARM)
        self._rested = {}

    def find_exposure(self, instrument: InstrumentModel, sample: str, auto: AutoExposure) -> None:
        """Probe the brightest states and take the exposure that they ask for. Moves the axes, lights the sample."""
        self.tell("looking for the exposure")
        losses = -1
        with self.ledger.time("probing"):
            while losses != self.rig.light_losses():
                # Frames exposed while the light was shut from outside do not count.
                losses = self.rig.light_losses()
                probe = partial(find_exposure, self.rig, self.table, self.poses_deg, instrument)
                found_s = probe(sample=sample, auto=auto, observers=self.observers, warn=self.warn)
        self._light = None
        self._scale_exposure(found_s / auto.start_s)

    def start_darker(self, why: str) -> None:
        """Discard the states taken and continue with a shorter exposure."""
        self.warn(f"{why}; beginning again at {DARKER:g} of the exposure")
        self.writer.forget()
        self.checks.evidence.forget()
        self.ledger.states = 0
        self._scale_exposure(DARKER)

    def _scale_exposure(self, factor: float) -> None:
        # Three digits: the camera sets no more, and a person can read them.
        exposure_s = np.array([float(f"{factor * value:.3g}") for value in self.table.exposure_s])
        self.table = replace(self.table, exposure_s=exposure_s)
        self.writer.set_exposure(exposure_s)

    def warn(self, text: str) -> None:
        """Keep a warning for the closing record and tell the observers."""
        log.warning("%s", text)
        self.messages.add(text)
        for observer in self.observers:
            observer.warning(text)

    # --- one state ---------------------------------------------------------------------------------------

    def _take(self, state: int, before: _Exposed | None) -> _Exposed | None:
        targets = self.poses_deg[state]
        if self._last_state != state - 1 and not self.rig.is_free(targets):
            # The way from one state to the next is free, as the plan's check has found; other ways may not be.
            if before is not None:
                self._collect(before)
                before = None
            self.go(state, "moving")
        self._last_state = state
        changed = {axis: target for axis, target in targets.items() if self._pose_deg.get(axis) != target}
        # The longest move first: the others start while it is under way.
        changed = dict(sorted(changed.items(), key=lambda item: -self._move_s(*item)))
        motions = self.rig.start_moves(changed)
        self._require_rested(state, motions)
        longest_s = max((motion.expected_s for motion in motions.values()), default=0.0) / self.rig.time_scale
        if before is not None:
            self._collect(before)
        with self.ledger.time("moving"):
            positions = self.rig.wait(motions)
        self._pose_deg.update(changed)
        self.set_light(self.table.role[state] != "dark")
        settle_s = self.rig.config.settle_s if changed else 0.0
        with self.ledger.time("settling"):
            self.rig.clock.sleep_s(settle_s)
        self.ledger.unavoidable_s += longest_s + settle_s
        return self._expose(state, targets, positions)

    def _move_s(self, axis: str, target_deg: float) -> float:
        start_deg = self._pose_deg.get(axis)
        return 0.0 if start_deg is None else self.rig.axes[axis].move_time_s(target_deg - start_deg)

    def _expose(self, state: int, targets: Mapping[str, float], moved: dict[str, Position]) -> _Exposed | None:
        retake = self._retakes.get(state, 0)
        for observer in self.observers:
            observer.exposing(state, retake)
        camera = self.rig.require_camera()
        with self.ledger.time("setting"):
            asked_s = float(self.table.exposure_s[state])
            settings = self.rig.set_exposure(asked_s, int(self.table.repeats[state]))
        # Cameras set exposures in steps; what counts is the exposure that was.
        exposure_s = settings.exposure_s or asked_s
        self._clock_jumped()
        start_s = self.rig.clock.now_s()
        with self.ledger.time("exposure"):
            try:
                exposure = camera.trigger()
                # Axes that stood still are read while the light is collected: it costs no time.
                resting = {axis: self.rig.axes[axis].read_position() for axis in targets if axis not in moved}
                exposure.wait_exposed()
            except FrameLost as error:
                self._retake(state, error)
                return None
        light_s = exposure_s * float(self.table.repeats[state])
        # The camera's own: until it says that the exposure has ended, beyond the exposure itself. The pause between
        # two questions, a millisecond, is in it.
        readout_s = max(0.0, self.rig.clock.now_s() - start_s - light_s)
        self.ledger.readout_s += readout_s
        self.ledger.unavoidable_s += light_s + readout_s
        if self._light_was_lost() or self._clock_jumped():
            self.warn(f"state {state} is taken again")
            self._pending.appendleft(state)
            return None
        positions = moved | resting
        self._require_on_target(state, targets, positions)
        # Looked at after the exposure: it also tells of an interlock that was open before it.
        temperature_c = camera.temperature_c()
        temperature = float("nan") if temperature_c is None else temperature_c
        blocked = self.interlocks.open_now()
        if blocked is not None:
            self._discard(state, f"{blocked} in state {state}")
            return None
        where = {axis: positions[axis] for axis in targets}
        self._rested = where
        return _Exposed(state, exposure, where, retake, exposure_s, temperature, self._wall_clock.ahead_s, settings)

    def _collect(self, exposed: _Exposed) -> None:
        with self.ledger.time("transfer"):
            try:
                frame = exposed.exposure.frame()
                self.checks.require_as_reported(exposed.state, frame, exposed.settings, self.rig)
            except FrameLost as error:
                self._retake(exposed.state, error)
                return
        role, full_scale = self.table.role[exposed.state], self.rig.require_camera().full_scale
        report = self.checks.report(
            exposed.state, role, exposed.positions, exposed.exposure_s, frame=frame, full_scale=full_scale
        )
        # In a bracket the longer exposures are meant to saturate.
        shortest = self.table.exposure_s[exposed.state] <= 1.001 * self.table.exposure_s.min()
        if self._saturation_limit is not None and shortest and report.saturated_fraction > self._saturation_limit:
            percent = 100 * report.saturated_fraction
            raise TooBright(f"state {exposed.state}: {percent:.2f} % of the pixels are saturated")
        blocked = self.interlocks.judge(report, meant_to_saturate=not shortest)
        if blocked is not None:
            self._discard(exposed.state, blocked)
            return
        planned_s = float(self.table.exposure_s[exposed.state])
        pose = tuple(float(column[exposed.state]) for column in self.table.angles_deg.values())
        self.checks.look(report, frame, planned_s, pose)
        columns = {
            "exposure_s": exposed.exposure_s,
            "host_time_s": frame.host_time_s - exposed.clock_ahead_s,
            "camera_time_ns": frame.camera_time_ns,
            "frame_id": frame.frame_id,
            "retakes": exposed.retake,
            "saturated_fraction": report.saturated_fraction,
            "near_black_fraction": report.near_black_fraction,
            "monitor": report.monitor,
            "camera_temperature_c": exposed.temperature_c,
            "full_scale_counts": full_scale,
        }
        with self.ledger.time("writing"):
            self._wait_for_disc()
            self.writer.put(StateRecord(exposed.state, frame.pixels, exposed.positions, columns))
        self.ledger.states += 1
        for observer in self.observers:
            observer.state_done(report)

    def _wait_for_disc(self) -> None:
        """Measure nothing while the disc takes nothing: the light is shut, and no further move begins."""
        if self.writer.is_settled():
            return
        self.set_light(False)
        self.warn("the disc takes no data: the light is shut until it does")
        self.writer.settle()

    # --- what can be wrong with it -----------------------------------------------------------------------

    def _light_was_lost(self) -> bool:
        """Report a light that was shut from outside since it was last switched."""
        for text in self.rig.guard_news():
            self.warn(text)
        return self.rig.light_losses() != self._light_losses

    def _clock_jumped(self) -> bool:
        """Report a clock that was set, or a machine that slept, since the last look."""
        jump = self._wall_clock.look()
        if jump is None:
            return False
        self.warn(f"{jump}; times in the capture continue evenly")
        self.rig.require_camera().forget_clock()
        return True

    def _require_rested(self, state: int, motions: Mapping[str, Motion]) -> None:
        """Stop at an axis that has moved, or lost its count, since the state before. Raises RunFailed."""
        for axis, motion in motions.items():
            before, start = self._rested.get(axis), motion.start
            if before is None or start is None:
                continue
            difference, unit = start.deg - before.deg, self.rig.axes[axis].config.unit
            if abs(difference) > self.rig.axes[axis].config.tolerance_deg:
                raise RunFailed(
                    f"state {state}: axis {axis} rested at {before.deg:.4f} {unit} in the state before and reads "
                    f"{start.deg:.4f} {unit} before its next move: its controller restarted, or something turned it. "
                    f"Home it (acquire home {axis}), then continue with --resume."
                )

    def _retake(self, state: int, error: FrameLost) -> None:
        tries = self._retakes.get(state, 0) + 1
        self._retakes[state] = tries
        allowed = self.rig.config.retakes
        if tries > allowed:
            raise RunFailed(
                f"state {state}: {tries} frames in a row were lost, the last: {error.came_back}. {error.what_to_do}. "
                "Then continue with --resume."
            ) from error
        self.warn(f"state {state}: frame lost ({error.came_back}), taken again, try {tries} of {allowed}")
        self._pending.appendleft(state)

    def _require_on_target(self, state: int, targets: Mapping[str, float], positions: Mapping[str, Position]) -> None:
        for axis, target in targets.items():
            difference, unit = positions[axis].deg - target, self.rig.axes[axis].config.unit
            if abs(difference) > self.rig.axes[axis].config.tolerance_deg:
                raise RunFailed(
                    f"state {state}: axis {axis} should stand at {target:.4f} {unit} and reads "
                    f"{positions[axis].deg:.4f} {unit} after it had arrived. Something moved it; the state is not kept."
                )

    def _discard(self, state: int, why: str) -> None:
        self._pending.appendleft(state)
        with self.ledger.time("interlock"):
            self.interlocks.hold(state, why, self.stop)
        # The shutter may have fallen with the interlock.
        self._light = None

    def set_light(self, on: bool) -> None:
        """Switch the light, unless it is known to be so; a light that may have been lost is switched again."""
        source = self.rig.source
        losses = self.rig.light_losses()
        if source is None or (self._light == on and losses == self._light_losses):
            return
        self._light_losses = losses
        with self.ledger.time("shutter"):
            source.set_light(on)
        self._light = on
