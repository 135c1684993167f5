"""A whole capture as a bluesky device, with what a pause leaves and where its frames are."""

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from acquisition.bluesky_devices.axis_and_camera import AxisDevice
from acquisition.bluesky_devices.device import BlueskyDevice, Readings, data_key, readings
from acquisition.bluesky_devices.frames_in_files import Documents, asset_documents, external_key
from acquisition.bluesky_devices.settings import InterlockDevice, SettingDevice
from acquisition.bluesky_devices.status import MoveStatus, in_background
from acquisition.capture import session
from acquisition.capture.checks import refuse_failed
from acquisition.capture.free_name import free_name
from acquisition.capture.header import default_name
from acquisition.capture.job import Job, Result, check_with_devices, job_of, prepare
from acquisition.capture.partial_file import PARTIAL
from acquisition.capture.plan import MeasurementPlan
from acquisition.errors import AcquisitionError, InterlockOpened
from acquisition.rig.rig import Rig
from acquisition.stop_request import StopRequest
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import COLUMN_UNITS, position_column

#: Columns of the file with a value for each state, in addition to the angles.
COLUMNS = ("exposure_s", "host_time_s", "monitor", "saturated_fraction")
#: A suspender sees an open interlock within this time, if at all.
_SEEN_S = 1.0


class CaptureDevice(BlueskyDevice):
    """A whole capture: one `trigger` takes all its states into a file, and seals it.

    If the RunEngine pauses, the state that is being taken is finished and the light is shut; when it resumes, the same
    file is gone on with, as `acquire --resume` does. `read` gives the file, and angles and columns of its states;
    the frames stay in the file, which a stream document points to. Once a plan has moved the arm, Omega is where the
    arm was sent: a scan of the arm takes a capture at each of its angles. Until then it is that of `plan`.

    Parameters
    ----------
    plan : of every capture that this device takes.
    folder : for the files, which are named as `acquire` names them.
    home : home axes without a reference before the first move of a capture.
    arm : the arm of the rig; None for a rig without.
    interlock : a suspender that watches it pauses the capture when it opens, which otherwise fails.

    Attributes
    ----------
    stop_request : to the capture that is being taken, which ends after its state.
    """

    def __init__(
        self,
        name: str,
        rig: Rig,
        turn: threading.Lock,
        plan: MeasurementPlan,
        *,
        folder: Path | str,
        home: bool,
        arm: AxisDevice | None,
        interlock: InterlockDevice,
    ) -> None:
        super().__init__(name, rig, turn)
        self.plan, self.folder = plan, Path(folder)
        self._arm, self._interlock = arm, interlock
        self._home = home
        self._job = prepare(plan, rig.config)
        self.stop_request = StopRequest()
        self._half: Path | None = None
        self._path: Path | None = None
        self._taking: MoveStatus | None = None
        self._documents: list[tuple[str, dict[str, Any]]] = []

    def trigger(self) -> MoveStatus:
        """Take the capture, or the states that are missing after a pause."""
        self.stop_request = StopRequest()
        self._taking = in_background(self._take_or_pause)
        return self._taking

    def _take_or_pause(self) -> None:
        try:
            self._take()
        except InterlockOpened:
            if not self._await_pause():
                raise

    def _take(self) -> None:
        with self.turn:
            half = self._half
            if half is None and self._arm is not None and self._arm.target_deg is not None:
                self._change(omega_deg=self._arm.target_deg)
            if half is not None:
                result = self._run(session.resume, job_of(half, self.rig.config, self.plan), half)
            else:
                with free_name(self.folder / default_name(self.plan)) as path:
                    result = self._run(session.take, self._job, path)
        if result.status == "complete":
            self._half, self._path = None, result.path
            self._documents = list(self._asset_documents(result.path))
        else:
            self._half = result.path

    def _change(self, **values: Any) -> None:
        """Take the next captures with other values of the plan. Raises PlanRefused, ValidationError."""
        plan = MeasurementPlan.model_validate(self.plan.model_dump() | values)
        if plan != self.plan:
            self._job = prepare(plan, self.rig.config)
            self.plan = plan

    def setting(self, key: Literal["exposure_s", "wavelength_nm"]) -> SettingDevice:
        """A number of the plan as a device that a plan of bluesky can move."""
        unit = {"exposure_s": "s", "wavelength_nm": "nm"}[key]
        return SettingDevice(
            f"{self.name}_plan_{key}",
            self.rig,
            self.turn,
            get=lambda: self._number(key),
            change=lambda value: self._change(**{key: value}),
            unit=unit,
        )

    def _number(self, key: str) -> float:
        value = getattr(self.plan, key)
        return float(value) if isinstance(value, int | float) else math.nan

    def configure(self, values: dict[str, Any]) -> tuple[Readings, Readings]:
        """Change values of the plan, such as `wavelength_nm`; returns the configuration before and after.

        Raises PlanRefused, ValidationError: the rig cannot do it, or the plan has no such value.
        """
        before = self.read_configuration()
        with self.turn:
            self._change(**values)
        return before, self.read_configuration()

    def _configuration(self) -> dict[str, tuple[Any, str]]:
        identity = self.rig.require_camera().describe()
        configuration: dict[str, tuple[Any, str]] = {
            "mode": (self.plan.mode, ""),
            "sample": (self.plan.sample.name or self.plan.sample.kind, ""),
            "wavelength_nm": (self.plan.wavelength_nm, "nm"),
            "camera_serial_number": (identity.serial_number, ""),
        }
        exposure_s = self._number("exposure_s")
        return configuration | ({} if math.isnan(exposure_s) else {"plan_exposure_s": (exposure_s, "s")})

    def _run(self, run: Callable[..., Result], job: Job, path: Path) -> Result:
        refuse_failed(check_with_devices(job, self.rig, path.parent))
        try:
            return run(job, self.rig, path, self.stop_request, home=self._home)
        except BaseException:
            # An existing partial file is resumed when the plan runs again.
            partial = path if path.name.endswith(PARTIAL) else path.with_name(path.name + PARTIAL)
            self._half = partial if partial.exists() else None
            raise

    def _await_pause(self) -> bool:
        """True if a suspender has seen the interlock too, and asks for a pause."""
        end_s = time.monotonic() + _SEEN_S
        while self._interlock.is_watched and not self.stop_request.requested and time.monotonic() < end_s:
            time.sleep(0.01)
        return self.stop_request.requested

    def pause(self) -> None:
        """Finish the state that is being taken; called by the RunEngine."""
        if self._taking is not None and not self._taking.done:
            self.stop_request.request()
            self._taking.exception(timeout=None)

    def resume(self) -> None:
        """Do nothing: the RunEngine triggers again, which resumes the capture."""

    def stop(self, *, success: bool = False) -> None:
        """End after the state that is being taken; `acquire --resume` continues the file."""
        self.stop_request.request()

    def _column(self, axis: str) -> tuple[str, str]:
        return position_column(f"{self.name}_{axis}", self.rig.config.axes[axis].unit == "V")

    def _require_path(self) -> Path:
        if self._path is None:
            raise AcquisitionError(f"{self.name} has taken no capture yet; trigger it first.")
        return self._path

    def read(self) -> Readings:
        """File, angles as read back and columns, of the capture that was taken last."""
        with Capture(self._require_path()) as capture:
            values: dict[str, Any] = {f"{self.name}_file": str(capture.path)}
            values |= {self._column(axis)[0]: angles for axis, angles in capture.angles_deg.items()}
            values |= {f"{self.name}_{column}": capture.column(column) for column in COLUMNS}
        return readings(values)

    def describe(self) -> Readings:
        """Shapes and units; the frames are (states, channels, rows, columns)."""
        states = (len(self._job.table),)
        keys = {f"{self.name}_file": {"source": "capture file", "dtype": "string", "shape": []}}
        for axis in self._job.table.angles_deg:
            name, unit = self._column(axis)
            keys[name] = data_key(f"axis {axis}, as read back in each state", states, unit)
        keys |= {f"{self.name}_{c}": data_key(c, states, COLUMN_UNITS.get(c, "")) for c in COLUMNS}
        settings = self.rig.require_camera().settings
        frames = data_key("counts", (*states, 1, settings.height or 0, settings.width or 0), "count")
        return keys | {f"{self.name}_frames": external_key(frames)}

    def collect_asset_docs(self, index: int | None = None) -> Documents:
        """Where the frames of the last capture are; each file once."""
        documents, self._documents = self._documents, []
        yield from documents

    def _asset_documents(self, path: Path) -> Documents:
        with Capture(path) as capture:
            chunk = (1, 1, *capture.stored_shape)
        return asset_documents(f"{self.name}_frames", path, "/entry/instrument/detector/data", chunk)
