"""The open rig: the only holder of live hardware. Opening it moves nothing and changes no light."""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from acquisition.cleanup import Step, run_all
from acquisition.disc import on_disc
from acquisition.errors import AcquisitionError
from acquisition.rig.alarms import ACKNOWLEDGE
from acquisition.rig.config import RigConfig, clock_of
from acquisition.rig.guard import TRY_S
from acquisition.rig.guarded import BEAT_S, Guarding, WatchedSource
from acquisition.rig.joint_axes import JointAxes
from acquisition.screen.observer import Observer
from drivers.camera import Camera, CameraSettings
from drivers.errors import CommandRejected, DeviceError
from drivers.motion import MotionAxis
from drivers.registry import open_axis, open_camera, open_source
from drivers.serial_link import LineRegistry
from drivers.sources.manual import Ask, ManualSource
from processing.instrument.model import InstrumentModel
from processing.whole_file import make_plain

log = logging.getLogger(__name__)


@contextmanager
def _errors_of(device: str) -> Iterator[None]:
    """Errors of opening a port name the port; a person looks for the device that the rig file names."""
    try:
        yield
    except DeviceError as error:
        if device not in error.asked:
            error.asked = f"{device}, {error.asked}"
        raise


class Rig(JointAxes):
    """Named axes, a camera and a light source, opened from a rig file; a context manager.

    Attributes
    ----------
    axes : dict of name to MotionAxis
    camera : Camera or None where it was not asked for
    source : LightSource or None where the rig has none
    clock : Clock
        Of every wait and deadline.
    last_frame : ndarray or None
        Pixels of the last frame of a capture, which a frozen camera gives again in the next one.

    Parameters
    ----------
    ask
        Shows the operator what a source without a cable needs and returns True when it is done.

    Examples
    --------
    >>> from acquisition import Rig, load_rig, open_rig
    >>> with open_rig(load_rig("rig.yaml"), with_camera=False) as rig:
    ...     isinstance(rig, Rig), rig.source.is_on(), rig.camera
    (True, False, None)
    """

    def __init__(self, config: RigConfig, *, with_camera: bool = True, ask: Ask | None = None) -> None:
        super().__init__(config, clock_of(config))
        self.camera: Camera | None = None
        self.last_frame: NDArray[np.uint16] | None = None
        self.source: WatchedSource | None = None
        self._camera_entry = config.camera
        self._camera_settings: CameraSettings | None = None
        self._read_back = CameraSettings()
        self._with_camera = with_camera
        self._ask = ask
        self._lines = LineRegistry(config.wire_log, self.clock)
        #: From the first light on.
        self.guarding: Guarding | None = None
        self._stop_failed: str | None = None
        self._was_stopped = False
        self._own_losses = 0
        self._guard_news: deque[str] = deque(maxlen=100)

    def __enter__(self) -> Self:
        try:
            self._open()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, Exception):
            self.call_for_help(error)
        failure = self.close()
        if failure is not None:
            if error is None:
                raise failure
            error.add_note(f"closing the rig failed too: {failure}")

    def _open(self) -> None:
        self.start()
        for name in self.config.axes:
            with _errors_of(f"axis {name}"):
                self.open_axis(name)
        if self.config.source is not None:
            with _errors_of("source"):
                self.open_source()
        if self._with_camera:
            self.open_camera()

    def start(self) -> str:
        """Start the services that the devices need before they are opened; returns their description."""
        return self.config.name

    def show(
        self,
        sample: str,
        wavelength_nm: float | None = None,
        *,
        mode: str | None = None,
        instrument: InstrumentModel | None = None,
        omega_deg: float | None = None,
    ) -> None:
        """Place a sample before the optics and set the filter. On a real rig the operator does this.

        Parameters
        ----------
        wavelength_nm : of the light; None: the first of the rig.
        mode : mode of the rig file; None: the first.
        instrument : as declared; None: that of the mode.
        omega_deg : angle of the arm that comes next, if it is known.
        """

    def observers(self) -> Sequence[Observer]:
        """Observers that a run on this rig needs in addition to its own."""
        return ()

    def open_axis(self, name: str) -> MotionAxis:
        """Open one axis of the rig file; moves nothing."""
        self.axes[name] = open_axis(name, self._resolve_port(self.config.axes[name]), self._lines)
        return self.axes[name]

    def open_source(self) -> WatchedSource:
        """Open the light source; changes no light."""
        if self.config.source is None:
            raise AcquisitionError(f"rig {self.config.name!r} has no source")
        entry = self._resolve_port(self.config.source)
        source = open_source(entry, self._lines)
        if isinstance(source, ManualSource):
            source.ask = self._ask
        self.source = WatchedSource(source, self._require_guard)
        return self.source

    def open_camera(self) -> Camera:
        """Open the camera; exposes nothing."""
        camera = open_camera("camera", self._camera_entry, self.clock)
        self.camera = camera
        return camera

    def _resolve_port(self, entry: Any) -> Any:
        """The entry of a device, with the port that it has now."""
        return entry

    # --- the guard ---------------------------------------------------------------------------------------

    def start_guard(self, journal: Path | None = None) -> None:
        """Have the rig watched from outside, if that is not done yet.

        Without this call the guard begins with the first light.

        Parameters
        ----------
        journal : the file that the guard appends to, or None.

        Raises
        ------
        AcquisitionError
            Something else than a file of its own is there, or the disc takes none.
        """
        if self.guarding is None:
            if journal is not None:
                try:
                    on_disc(f"look at {journal}", make_plain, journal)
                except OSError as error:
                    raise AcquisitionError(
                        f"{journal} cannot be written ({error.strerror}). Remove it, or give another folder with --out."
                    ) from error
            self.guarding = Guarding(
                self.config, journal, self._lines.descriptors(), self._shut_at_once, tell=self._guard_says
            )

    def _guard_says(self, text: str) -> None:
        # At once: before the first state, and in a long exposure, the messages are not read.
        log.warning("%s", text)
        self._guard_news.append(text)

    def _require_guard(self) -> None:
        self.start_guard()
        if self.guarding is not None:
            self.guarding.require()

    def _shut_at_once(self) -> None:
        if self.source is not None and self.source.is_lit and not isinstance(self.source.inner, ManualSource):
            self.source.set_light(False)

    def light_losses(self) -> int:
        """How often the light was shut from outside so far: what was exposed meanwhile does not count."""
        return self._own_losses + (0 if self.guarding is None else self.guarding.losses)

    def lose_light(self, why: str) -> None:
        """Shut the light from any thread; what is exposed meanwhile does not count."""
        self._own_losses += 1
        try:
            self._shut_at_once()
        except Exception as error:  # noqa: BLE001 - the end of the run tries again, and the words must come
            why = f"{why}. THE LIGHT IS NOT SHUT: {error}"
        self._guard_says(why)

    def guard_news(self) -> list[str]:
        """Messages of the guard's watch since the last call."""
        return [self._guard_news.popleft() for _ in range(len(self._guard_news))]

    def call_for_help(self, error: Exception) -> None:
        """Have the guard run the rig's alert command with an error, once."""
        if self.guarding is not None:
            self.guarding.say_failed(str(error))

    def _end_guard(self, will_retry: bool) -> None:
        """Let the guard rest, or give it a light or an axis that does not obey. Raises AcquisitionError."""
        guarding, self.guarding = self.guarding, None
        if guarding is None:
            return
        disobeyed = self.source.disobeyed if self.source is not None else None
        if will_retry and disobeyed is not None:
            guarding.say_failed(f"THE LIGHT IS NOT SHUT, it is tried again for {TRY_S:g} s: {disobeyed}")
            with contextlib.suppress(AcquisitionError):
                self.insist_on_dark()
            assert self.source is not None
            disobeyed = self.source.disobeyed
        # The next try opens the axes anew.
        restless = None if will_retry else self._stop_failed or self._unconfirmed_stop()
        problems = [text for text in (disobeyed, restless) if text is not None]
        text = f"acquire could not make the rig safe: {'; '.join(problems)}" if problems else None
        if not guarding.end(text):
            self.insist_on_dark()
        elif text is not None:
            dangers = (disobeyed and "THE LIGHT MAY BE ON", restless and "AN AXIS MAY MOVE")
            raise AcquisitionError(
                f"{text}. {', '.join(filter(None, dangers))}. The guard tries again and gives the alarm until somebody "
                f"acknowledges it: {ACKNOWLEDGE}"
            )

    def _unconfirmed_stop(self) -> str | None:
        """The first axis that was sent a stop and gives no valid answer since, in words; None if all answer."""
        for name, axis in self.axes.items() if self._was_stopped else ():
            try:
                axis.is_moving()
            except CommandRejected:
                # The line is well: some controllers answer no question while they move.
                continue
            except Exception as error:  # noqa: BLE001 - whatever it was, somebody has to look at the axis
                return f"axis {name} was sent a stop and does not answer whether it rests ({error})"
        return None

    def insist_on_dark(self) -> None:
        """Try for a minute to shut a light that did not obey. Raises AcquisitionError."""
        end_s = time.monotonic() + TRY_S
        while self.source is not None and self.source.disobeyed is not None:
            try:
                self.source.set_light(False)
            except Exception as error:
                if time.monotonic() > end_s:
                    raise AcquisitionError(
                        f"THE LIGHT IS NOT SHUT after {TRY_S:g} s of tries: {error}. Switch it off by hand."
                    ) from error
                time.sleep(BEAT_S)

    def stop(self) -> Exception | None:
        """Shut the light that this program has lit and stop every axis, whatever they answer; the first failure.

        Light first: the axes are sent their stop meanwhile, but no later than an answer of the light takes.
        """
        shut = threading.Thread(target=run_all, args=([("shut off the light", self._shut_at_once)],), daemon=True)
        try:
            shut.start()
        except RuntimeError:
            # No thread is available: one after the other.
            shut.run()
        failure = super().stop()
        self._was_stopped = True
        with contextlib.suppress(RuntimeError):
            shut.join()
        self._stop_failed = None if failure is None else str(failure)
        return failure

    @property
    def time_scale(self) -> float:
        """Seconds of the devices for one second here."""
        return 1.0

    # --- the rest ----------------------------------------------------------------------------------------

    def set_exposure(self, exposure_s: float, repeats: int) -> CameraSettings:
        """Set exposure and averaging, unless they are set so already; returns the settings as read back."""
        # The trigger is that of the rig file.
        settings = CameraSettings(exposure_s=exposure_s, frame_average=repeats)
        if self._camera_settings != settings:
            self._camera_settings = None
            self._read_back = self.require_camera().configure(settings)
            self._camera_settings = settings
        return self._read_back

    def forget_exposure(self) -> None:
        """Set the exposure anew with the next frame: the camera has another one than it was set to."""
        self._camera_settings = None

    def require_camera(self) -> Camera:
        """The camera; AcquisitionError if the rig was opened without."""
        if self.camera is None:
            raise AcquisitionError("this rig was opened without its camera")
        return self.camera

    def describe(self) -> dict[str, Any]:
        """Identities of all devices, for the capture file."""
        from dataclasses import asdict

        devices: dict[str, Any] = {name: asdict(axis.describe()) for name, axis in self.axes.items()}
        if self.camera is not None:
            devices["camera"] = asdict(self.camera.describe())
        if self.source is not None:
            devices["source"] = self.source.describe()
        # The port as the rig file has it: a pseudo-terminal's number means nothing tomorrow.
        for name, entry in (*self.config.axes.items(), ("source", self.config.source)):
            if name in devices and (port := getattr(entry, "port", None)) is not None:
                devices[name]["port"] = port
        return devices

    def close(self, *, will_retry: bool = False) -> Exception | None:
        """Release every device; moves and stops nothing. Returns the first failure.

        Parameters
        ----------
        will_retry : this program opens the rig again and tries itself what did not obey.
        """
        return run_all(self._steps_of_closing(will_retry=will_retry))

    def _steps_of_closing(self, *, will_retry: bool) -> list[Step]:
        steps: list[Step] = [("end the guard", partial(self._end_guard, will_retry))]
        if self.camera is not None:
            steps.append(("close the camera", self.camera.close))
        if self.source is not None:
            steps.append(("close the source", self.source.close))
        steps += [(f"close axis {name}", axis.close) for name, axis in self.axes.items()]
        return [*steps, ("close the ports", self._lines.close)]
