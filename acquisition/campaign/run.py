"""Runs a campaign: checks everything before the first motion, and resumes a capture where it stopped."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.campaign.identity import require_same_campaign, with_devices
from acquisition.campaign.log import CampaignFolder, entry_of
from acquisition.campaign.plan import Campaign, CampaignCapture, captures
from acquisition.capture import session
from acquisition.capture.checks import CheckResult, refuse_failed
from acquisition.capture.estimate import capture_seconds, last_pose_deg
from acquisition.capture.identity import require_same
from acquisition.capture.job import Job, Result, check_disc, check_with_devices, job_of
from acquisition.capture.job import prepare as prepare_job
from acquisition.capture.machine_checks import check_machine
from acquisition.capture.operator import Operator
from acquisition.capture.partial_file import PARTIAL, bytes_needed, seal_whole
from acquisition.capture.plan import MeasurementPlan
from acquisition.disc import on_disc
from acquisition.errors import Differs, InterlockOpened, PlanRefused, Stopped, Unforeseen, as_run_error
from acquisition.rig.config import RigConfig
from acquisition.rig.guarded import GUARD_LOG
from acquisition.rig.interlocks import LOOK_S
from acquisition.rig.open_rig import open_rig
from acquisition.rig.rig import Rig
from acquisition.rig.turns import fold_angles, states_deg, unwind
from acquisition.screen.observer import Observer
from acquisition.stop_request import StopRequest
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture, CaptureError

#: Room for log and index, bytes.
BOOKS = 4 << 20


@dataclass(frozen=True)
class Planned:
    """A capture of the campaign with its checked job, estimated seconds and bytes."""

    capture: CampaignCapture
    job: Job
    seconds: float
    size: int


def prepare(campaign: Campaign, rig: RigConfig) -> list[tuple[CampaignCapture, Job]]:
    """Check every capture as far as files tell. Raises PlanRefused with all that is wrong, each once."""
    jobs = []
    failures: dict[str, str] = {}
    read = cache(InstrumentModel.load)
    for capture in captures(campaign):
        try:
            jobs.append((capture, prepare_job(capture.plan, rig, read)))
        except PlanRefused as refused:
            for failure in refused.failures:
                failures.setdefault(failure, capture.name)
    if failures:
        raise PlanRefused([f"{failure} (first in {name})" for failure, name in failures.items()])
    return jobs


def check_all(
    jobs: Sequence[tuple[CampaignCapture, Job]], rig: Rig, folder: Path
) -> tuple[list[Planned], list[CheckResult]]:
    """Check every capture against the devices and the disc; nothing moves. Returns failures and passes alike."""
    planned = []
    pose: dict[str, float] = {}
    start_deg = rig.pose_after_homing()
    results: dict[tuple[str, str], CheckResult] = {}
    for capture, job in jobs:
        table = unwind(fold_angles(job.table, rig), rig, start_deg)
        for check in check_with_devices(replace(job, table=table), rig, folder, start_deg):
            results.setdefault((check.title, check.detail), check)
        start_deg |= states_deg(table)[-1]
        settings = rig.require_camera().settings
        size = bytes_needed(len(job.table), 1, (settings.height or 0, settings.width or 0))
        planned.append(Planned(capture, job, capture_seconds(job, rig, pose), size))
        pose = pose | last_pose_deg(job)
    samples = [job.plan.sample.name or job.plan.sample.kind for _, job in jobs]
    checks = [*check_machine(rig.config, samples), *results.values()]
    missing = sum(p.size for p in planned if not (folder / p.capture.name).exists())
    return planned, [*checks, check_disc("disc for the campaign", folder, missing + BOOKS)]


def _trace(error: Exception) -> dict[str, str]:
    return {"traceback": error.trace} if isinstance(error, Unforeseen) else {}


class CampaignRun:
    """Takes the missing captures of a campaign, one by one.

    Parameters
    ----------
    folder : open; it holds log and index next to the captures.
    """

    def __init__(
        self,
        campaign: Campaign,
        rig: RigConfig,
        folder: CampaignFolder,
        operator: Operator,
        *,
        stop: StopRequest,
        observers: Sequence[Observer] = (),
        home: bool = False,
    ) -> None:
        self.campaign = campaign
        self.config = rig
        self.folder = folder
        self.operator = operator
        self.stop = stop
        self.observers = observers
        self.home = home
        self._rig: Rig | None = None
        self._last_frame: NDArray[np.uint16] | None = None

    def run(self, jobs: Sequence[tuple[CampaignCapture, Job]]) -> bool:
        """True if every capture is complete at the end, False if a stop was asked for.

        Raises AcquisitionError, DeviceError: a capture failed more often than the campaign allows.
        """
        self.folder.log("campaign started", captures=len(jobs), rig=self.config.name, simulated=self.config.simulated)
        try:
            for number, (capture, job) in enumerate(jobs):
                for observer in self.observers:
                    observer.campaign_progress(number, len(jobs), capture.name)
                if self._complete(capture, job):
                    self._catch_up(capture)
                    continue
                result = self.take(capture, job)
                if result is None or result.status == "aborted":
                    self.folder.log("campaign stopped", at=capture.name)
                    return False
            self.folder.log("campaign complete")
            return True
        except KeyboardInterrupt:
            self.folder.log("campaign stopped at once")
            raise
        except Exception as error:
            failure = as_run_error(error)
            if self._rig is not None:
                self._rig.call_for_help(failure)
            self.folder.log("campaign failed", error=str(failure), **_trace(failure))
            if failure is error:
                raise
            raise failure from error
        finally:
            self._close_rig()

    def take(self, capture: CampaignCapture, job: Job) -> Result | None:
        """Take a capture, as often as the campaign retries it; None if it is given up."""
        failures = 0
        while True:
            if self.stop.requested:
                return None
            done = self._states_done(capture)
            try:
                is_over = False
                rig = self._open_rig()
                selects = rig.source is not None and rig.source.selects_wavelength
                changed = self.operator.prepare(capture.plan, source_selects=selects)
                self.folder.log("capture started", capture=capture.name, states_done=done, operator=changed)
                self.folder.record(capture.name, status="running", reference=capture.reference)
                self._wait_for_door(rig, capture)
                result = self._take_once(capture, job, rig)
                is_over = True
            except Stopped:
                return None
            except Exception as unknown:
                error, is_over = as_run_error(unknown), True
                # A capture that got further was worth going on with: only tries without progress are counted.
                failures = failures + 1 if self._states_done(capture) <= done else 1
                self.folder.log(
                    "capture failed", capture=capture.name, error=str(error), tries=failures, **_trace(error)
                )
                self.folder.record(capture.name, status="failed", error=str(error))
                # An interlock is nothing to try again: whether the run goes on by itself is for the plan to say.
                if failures > self.campaign.retries or isinstance(error, InterlockOpened | Differs):
                    if error is unknown:
                        raise
                    raise error from unknown
                self._close_rig(will_retry=True)
                for observer in self.observers:
                    observer.warning(f"{error}; retrying in {self.campaign.retry_wait_s:g} s")
                self._pause(self.campaign.retry_wait_s)
                continue
            finally:
                if not is_over and self.folder.index.get(capture.name, {}).get("status") == "running":
                    self.folder.record(capture.name, status="stopped")
            self.folder.log(
                "capture ended", capture=capture.name, status=result.status, states=result.states_done,
                saturated_fraction=result.saturated_fraction, ledger=result.ledger, messages=result.messages,
            )  # fmt: skip
            self.folder.record(capture.name, **on_disc(f"read {result.path}", entry_of, capture, result.path))
            return result

    def _wait_for_door(self, rig: Rig, capture: CampaignCapture) -> None:
        """A door open between captures: wait, if the campaign goes on by itself. Raises InterlockOpened."""
        if rig.source is None or not rig.source.interlock_open():
            return
        if not self.campaign.continue_after_interlock:
            raise InterlockOpened(
                f"the door is open before {capture.name}. Nothing was moved. Close it, then repeat the same command."
            )
        self.folder.log("waiting", capture=capture.name, why="the door is open")
        for observer in self.observers:
            observer.warning("the door is open; waiting until it is closed")
        while rig.source.interlock_open() and not self.stop.requested:
            rig.clock.sleep_s(LOOK_S)

    def _take_once(self, capture: CampaignCapture, job: Job, rig: Rig) -> Result:
        final = self.folder.folder / capture.name
        partial = on_disc(f"look at {final}", _existing_file, final)
        if partial is not None:
            job = on_disc(f"read {partial}", job_of, partial, self.config, capture.plan)
            refuse_failed(check_with_devices(job, rig, final.parent))
            return session.resume(job, rig, partial, self.stop, observers=self.observers, home=self.home)
        refuse_failed(check_with_devices(job, rig, final.parent))
        return session.take(job, rig, final, self.stop, observers=self.observers, home=self.home)

    def _complete(self, capture: CampaignCapture, job: Job) -> bool:
        """Whether a capture is there, whole, and of this campaign. Raises Differs."""
        path = self.folder.folder / capture.name
        if on_disc(f"look at {path}", _seal, path):
            self.folder.log("sealed", capture=capture.name, why="its run was killed after the last state")
        return on_disc(f"read {path}", _is_complete, path, capture.plan, self.config, job.instrument)

    def _catch_up(self, capture: CampaignCapture) -> None:
        """Put a complete capture into the index, where a kill or a full disc has kept it out."""
        if self.folder.index.get(capture.name, {}).get("status") != "complete":
            path = self.folder.folder / capture.name
            self.folder.record(capture.name, **on_disc(f"read {path}", entry_of, capture, path))

    def _states_done(self, capture: CampaignCapture) -> int:
        path = self.folder.folder / capture.name
        return on_disc(f"read {path}", _states_in, path)

    @property
    def rig(self) -> Rig | None:
        """The rig that is open now, for observers of a simulated one."""
        return self._rig

    def _open_rig(self) -> Rig:
        if self._rig is None:
            rig = open_rig(self.config, ask=self.operator.confirm)
            rig.__enter__()
            self._rig, rig.last_frame = rig, self._last_frame
            # A device may have been changed between two tries.
            on_disc("read the campaign", require_same_campaign, self.folder.folder, with_devices({}, rig))
            rig.start_guard(self.folder.folder / GUARD_LOG)
        return self._rig

    def _close_rig(self, *, will_retry: bool = False) -> None:
        rig, self._rig = self._rig, None
        if rig is not None:
            self._last_frame = rig.last_frame
        failure = rig.close(will_retry=will_retry) if rig is not None else None
        if failure is not None:
            self.folder.log("closing the rig failed", error=str(failure))
            for observer in self.observers:
                observer.warning(f"closing the rig failed: {failure}")

    def _pause(self, seconds: float) -> None:
        # Real time: the pause is for people and devices.
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s and not self.stop.requested:
            time.sleep(0.05)


# --- what the disc process does --------------------------------------------------------------------------------------


def _existing_file(final: Path) -> Path | None:
    """The file of a capture that is there, under its final name (aborted by Ctrl-C, or whole) or its partial one."""
    return next((path for path in (final, final.with_name(final.name + PARTIAL)) if path.exists()), None)


def _seal(final: Path) -> bool:
    partial = final.with_name(final.name + PARTIAL)
    return partial.exists() and seal_whole(partial) is not None


def _is_complete(path: Path, plan: MeasurementPlan, config: RigConfig, instrument: InstrumentModel) -> bool:
    if not path.exists():
        return False
    with Capture(path) as capture:
        require_same(capture, plan, config, instrument)
        return capture.status == "complete"


def _states_in(final: Path) -> int:
    path = _existing_file(final)
    try:
        if path is not None:
            with Capture(path) as capture:
                return len(capture.done)
    except CaptureError:
        pass
    return 0
