"""The open rig: the only holder of live hardware. Opening it moves nothing and changes no light."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Self

from acquisition.cleanup import Step, run_all
from acquisition.errors import AcquisitionError
from acquisition.rig.alarms import ACKNOWLEDGE
from acquisition.rig.config import RigConfig, clock_of, has_own_emulators
from acquisition.rig.guard import TRY_S
from acquisition.rig.guarded import BEAT_S, Guarding, WatchedSource
from acquisition.rig.way import Pose, concerned, find_homing_obstacle, find_obstacle, find_way
from drivers.camera import Camera, CameraSettings
from drivers.clock import Clock
from drivers.errors import DeviceError, LimitError, MotionFailed
from drivers.motion import Limits, Motion, MotionAxis, Position
from drivers.registry import open_axis, open_camera, open_source
from drivers.serial_link import LineRegistry
from drivers.sources.manual import Ask, ManualSource
from processing.instrument.model import InstrumentModel
from simulators.rig.model import SCHEME
from simulators.rig.rig import SimulatedRig

log = logging.getLogger(__name__)

#: Shortest pause between two looks at a moving axis.
SHORTEST_LOOK_S = 0.002
#: Longest wait for moves that were started and given up.
REST_WITHIN_S = 60.0


@contextmanager
def _said_of(device: str) -> Iterator[None]:
    """Errors of opening a port name the port; a person looks for the device that the rig file names."""
    try:
        yield
    except DeviceError as error:
        if device not in error.asked:
            error.asked = f"{device}, {error.asked}"
        raise


class Rig:
    """Named axes, a camera and a light source, opened from a rig file; a context manager.

    Attributes
    ----------
    axes : dict of name to MotionAxis
    camera : Camera or None where it was not asked for
    source : LightSource or None where the rig has none
    simulation : SimulatedRig or None
    clock : Clock
        What every wait and deadline is counted by: real time, or with emulators the patient clock that they keep.

    Parameters
    ----------
    ask
        Shows the operator what a source without a cable needs and returns True when it is done.
    """

    def __init__(
        self,
        config: RigConfig,
        *,
        with_camera: bool = True,
        ask: Ask | None = None,
    ) -> None:
        self.config = config
        self.axes: dict[str, MotionAxis] = {}
        self.camera: Camera | None = None
        self.source: WatchedSource | None = None
        self.simulation: SimulatedRig | None = None
        self._asked: CameraSettings | None = None
        self._read_back = CameraSettings()
        self._with_camera = with_camera
        self._ask = ask
        self.clock: Clock = clock_of(config)
        self._lines = LineRegistry(config.wire_log, self.clock)
        self._guarding: Guarding | None = None
        self._stop_failed: str | None = None
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
        if self.config.simulator is not None:
            self.start_simulation()
        for name in self.config.axes:
            with _said_of(f"axis {name}"):
                self.open_axis(name)
        if self.config.source is not None:
            with _said_of("source"):
                self.open_source()
        if self._with_camera:
            self.open_camera()

    def start_simulation(self) -> str:
        """Start the emulators of a simulated rig; returns what was started."""
        if self.config.simulator is None:
            raise AcquisitionError(f"rig {self.config.name!r} has no `simulator` section")
        self.simulation = SimulatedRig(self.config.simulator, with_camera=self._with_camera)
        self.simulation.start()
        return ", ".join(self.config.simulator.ports)

    def show(self, sample: str, wavelength_nm: float | None = None) -> None:
        """On a simulated rig, put a sample before the optics of the first mode, as they truly are.

        Parameters
        ----------
        wavelength_nm : of the light; None: the first of the rig.
        """
        if self.simulation is None or self.config.simulator is None:
            return
        mode, declared = next(iter(self.config.modes.items()))
        model = InstrumentModel.load(self.config.simulator.truth.get(mode, declared.instrument))
        self.simulation.prepare(sample, model, wavelength_nm or self.config.wavelengths_nm[0])

    def open_axis(self, name: str) -> MotionAxis:
        """Open one axis of the rig file; moves nothing."""
        entry = self._at_port(self.config.axes[name])
        if self.simulation is not None:
            self.simulation.connect(name, entry.direction, entry.zero_deg)
        self.axes[name] = open_axis(name, entry, self._lines)
        return self.axes[name]

    def open_source(self) -> WatchedSource:
        """Open the light source; changes no light."""
        if self.config.source is None:
            raise AcquisitionError(f"rig {self.config.name!r} has no source")
        entry = self._at_port(self.config.source)
        source = open_source(entry, self._lines)
        if isinstance(source, ManualSource):
            source.ask = self._ask
            if self.simulation is not None:
                self.simulation.uncovered = source.is_on
        self.source = WatchedSource(source, self._require_guard)
        return self.source

    def open_camera(self) -> Camera:
        """Open the camera; exposes nothing."""
        entry = self.config.camera
        if self.simulation is not None:
            entry = entry.model_copy(update={"device": self.simulation.camera_device()})
        camera = open_camera("camera", entry, self.clock)
        self.camera = camera
        return camera

    def _at_port(self, entry: Any) -> Any:
        # What is switched by hand has no port.
        if not getattr(entry, "port", "").startswith(SCHEME):
            return entry
        if self.simulation is None:
            raise AcquisitionError(
                f"port {entry.port!r} is an emulator, but the rig file has no `simulator` section. "
                "Give the device path."
            )
        changes = {"port": self.simulation.port(entry.port.removeprefix(SCHEME))}
        # A filter wheel's shutter has a port of its own.
        if getattr(entry, "shutter", None) is not None:
            changes["shutter"] = self._at_port(entry.shutter)
        return entry.model_copy(update=changes)

    # --- the guard ---------------------------------------------------------------------------------------

    def start_guard(self, journal: Path | None = None) -> None:
        """Have the rig watched from outside, if that is not done yet.

        Emulators that end with this process need no guard. Without this call the guard begins with the first light.

        Parameters
        ----------
        journal : the file that the guard appends to, or None.
        """
        if self._guarding is None and not has_own_emulators(self.config):
            self._guarding = Guarding(
                self.config, journal, self._lines.descriptors(), self._shut_at_once, self._guard_says
            )

    def _guard_says(self, text: str) -> None:
        # At once: before the first state, and in a long exposure, nobody asks for the news.
        log.warning("%s", text)
        self._guard_news.append(text)

    def _require_guard(self) -> None:
        self.start_guard()
        if self._guarding is not None:
            self._guarding.require()

    def _shut_at_once(self) -> None:
        if self.source is not None and self.source.is_lit and not isinstance(self.source.inner, ManualSource):
            self.source.set_light(False)

    def light_losses(self) -> int:
        """How often the light was shut from outside so far: what was exposed meanwhile does not count."""
        return self._own_losses + (0 if self._guarding is None else self._guarding.losses)

    def lose_light(self, why: str) -> None:
        """Shut the light from any thread; what is exposed meanwhile does not count."""
        self._own_losses += 1
        try:
            self._shut_at_once()
        except Exception as error:  # noqa: BLE001 - the end of the run tries again, and the words must come
            why = f"{why}. THE LIGHT IS NOT SHUT: {error}"
        self._guard_says(why)

    def guard_news(self) -> list[str]:
        """What the guard's watch has had to say since the last call."""
        return [self._guard_news.popleft() for _ in range(len(self._guard_news))]

    def call_for_help(self, error: Exception) -> None:
        """Have the guard run the rig's alert command with an error, once."""
        if self._guarding is not None:
            self._guarding.say_failed(str(error))

    def _end_guard(self, will_retry: bool) -> None:
        """Let the guard rest, or give it a light or an axis that does not obey. Raises AcquisitionError."""
        guarding, self._guarding = self._guarding, None
        if guarding is None:
            return
        disobeyed = self.source.disobeyed if self.source is not None else None
        if will_retry:
            if disobeyed is not None:
                guarding.say_failed(f"THE LIGHT IS NOT SHUT, it is tried again for {TRY_S:g} s: {disobeyed}")
                with contextlib.suppress(AcquisitionError):
                    self.insist_on_dark()
                assert self.source is not None
                disobeyed = self.source.disobeyed
            # The next try opens the axes anew.
            self._stop_failed = None
        failed = [text for text in (disobeyed, self._stop_failed) if text is not None]
        text = f"acquire could not make the rig safe: {'; '.join(failed)}" if failed else None
        if not guarding.end(text):
            self.insist_on_dark()
        elif text is not None:
            raise AcquisitionError(
                f"{text}. THE LIGHT MAY BE ON, AN AXIS MAY MOVE. The guard tries again and gives the alarm until "
                f"somebody acknowledges it: {ACKNOWLEDGE}"
            )

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

    # --- motion ------------------------------------------------------------------------------------------

    def homing_order(self) -> list[str]:
        """Names of all axes: those of the rig file's `home_order` first."""
        return [*self.config.home_order, *(name for name in self.axes if name not in self.config.home_order)]

    def unhomed(self) -> list[str]:
        """Names of the axes without a reference, in homing order."""
        return [name for name in self.homing_order() if not self.axes[name].is_homed()]

    def home(self, names: list[str]) -> None:
        """Home the axes one after another.

        Raises
        ------
        AcquisitionError
            One of them may meet a forbidden pose or bring solids together on its way; nothing was moved.
        MotionFailed
            Every axis has been sent a stop by then.
        """
        found = find_homing_obstacle(self.config, names, self.where_known())
        if found is not None:
            raise AcquisitionError(f"{found}. Nothing was moved.")
        for name in names:
            self.wait({name: self.axes[name].home()})

    def move(self, targets_deg: Mapping[str, float]) -> dict[str, Position]:
        """Move axes at the same time and wait; returns the positions read back at rest.

        An axis with backlash comes to its target from below, if its limits leave room for that.
        """
        below = {}
        for name, slack in self.config.backlash_deg.items():
            if name in targets_deg and targets_deg[name] < self.axes[name].read_position().deg - 1e-6:
                below[name] = targets_deg[name] - slack
        beyond = dict(targets_deg) | below
        if below and self._allowed(beyond):
            self.wait(self.start_moves(beyond))
        return self.wait(self.start_moves(targets_deg))

    def go(self, targets_deg: Pose, by: Sequence[Pose] = (), first: str | None = None) -> None:
        """Move to a pose by the way that `find_way` finds, if need be round what is forbidden.

        Raises
        ------
        AcquisitionError
            There is no such way; nothing was moved.
        """
        way = find_way(self.config, self.where_known(), targets_deg, by, self.limits, first)
        if way is None:
            # Says what is met.
            self._check_way(targets_deg)
        for targets in way or []:
            self.move(targets)

    def _allowed(self, targets_deg: Mapping[str, float]) -> bool:
        try:
            for name, target in targets_deg.items():
                self.axes[name].check(target)
            self._check_way(targets_deg)
        except (LimitError, AcquisitionError):
            return False
        return True

    def start_moves(self, targets_deg: Mapping[str, float]) -> dict[str, Motion]:
        """Start axes at the same time; those that stand within a count of their target are started too."""
        for name, target in targets_deg.items():
            self.axes[name].check(target)
        self._check_way(targets_deg)
        motions: dict[str, Motion] = {}
        try:
            for name, target in targets_deg.items():
                motions[name] = self.axes[name].start_move(target)
        except BaseException:
            self.stop()
            raise
        return motions

    def _check_way(self, targets_deg: Mapping[str, float]) -> None:
        found = self._met(targets_deg)
        if found is not None:
            raise AcquisitionError(f"move to {dict(targets_deg)} meets {found}. Nothing was moved.")

    def is_free(self, targets_deg: Mapping[str, float]) -> bool:
        """Whether the axes can move there straight away."""
        return self._met(targets_deg) is None

    def _met(self, targets_deg: Mapping[str, float]) -> str | None:
        if not concerned(self.config) & targets_deg.keys():
            # Not even a position is read then: most moves are of rotators that nothing can hit.
            return None
        here = self.where_known()
        return find_obstacle(self.config, here, here | dict(targets_deg), targets_deg, self.limits)

    @property
    def limits(self) -> dict[str, Limits]:
        """Limits of every axis, the tighter ones of controller and rig file."""
        return {name: axis.limits for name, axis in self.axes.items()}

    def where_known(self) -> dict[str, float]:
        """Angles of the axes that forbidden poses and solids speak of, as far as they are known."""
        # Where an axis without a reference stands is not known, whatever it reads.
        axes = {name: self.axes[name] for name in concerned(self.config) if name in self.axes}
        return {name: axis.read_position().deg for name, axis in axes.items() if axis.is_homed()}

    def where_once_homed(self) -> dict[str, float]:
        """Angle of every axis after those without a reference have been homed, as far as the rig file tells.

        Where it does not, an axis is taken to end at its controller's zero.
        """
        ends = {name: path.ends_deg for name, path in self.config.homing.items()}
        return {
            name: axis.read_position().deg if axis.is_homed() else ends.get(name, axis.controller_zero_deg)
            for name, axis in self.axes.items()
        }

    def wait(self, motions: Mapping[str, Motion]) -> dict[str, Position]:
        """Wait for all motions and return the positions read back at rest.

        Raises
        ------
        MotionFailed
            As the first axis that failed has it; every axis has been sent a stop.
        """
        left = dict(motions)
        positions: dict[str, Position] = {}
        start_s = self.clock.now_s()
        try:
            while left:
                for name, motion in list(left.items()):
                    if motion.done():
                        positions[name] = motion.wait()
                        del left[name]
                if left:
                    self.clock.sleep_s(self._next_look_s(left, self.clock.now_s() - start_s))
        except MotionFailed as failure:
            others = self.stop()
            if others is not None:
                failure.add_note(f"stopping the other axes failed too: {others}")
            raise
        except BaseException:
            self.stop()
            raise
        return {name: positions[name] for name in motions}

    def rest(self) -> None:
        """Wait until no axis moves, for moves that nobody waits for any more."""
        for axis in self.axes.values():
            end_s = self.clock.now_s() + REST_WITHIN_S
            while axis.is_moving():
                if self.clock.now_s() > end_s:
                    self.stop()
                    raise AcquisitionError(f"axis {axis.name} still moves after {REST_WITHIN_S:g} s; it was stopped")
                self.clock.sleep_s(axis.config.poll_s)

    def _next_look_s(self, left: Mapping[str, Motion], elapsed_s: float) -> float:
        """Pause before the next look at moving axes: short around the time at which the last should arrive."""
        slowest = max(left.values(), key=lambda motion: motion.expected_s)
        off_s = abs(slowest.expected_s / self.time_scale - elapsed_s)
        longest_s = min(self.axes[name].config.poll_s for name in left)
        return min(max(off_s / 2, SHORTEST_LOOK_S), longest_s)

    def stop(self) -> Exception | None:
        """Shut the light that this program has lit and stop every axis, whatever they answer; the first failure.

        Light first: the axes are sent their stop meanwhile, but no later than an answer of the light takes.
        """
        shut = threading.Thread(target=run_all, args=([("shut off the light", self._shut_at_once)],), daemon=True)
        try:
            shut.start()
        except RuntimeError:
            # No thread to be had: one after the other, then.
            shut.run()
        failure = run_all([(f"stop axis {name}", axis.stop) for name, axis in self.axes.items()])
        with contextlib.suppress(RuntimeError):
            shut.join()
        self._stop_failed = None if failure is None else str(failure)
        return failure

    @property
    def time_scale(self) -> float:
        """Seconds of the devices for one second here: the emulators' clock may run fast."""
        return 1.0 if self.simulation is None else self.simulation.clock.speed

    # --- the rest ----------------------------------------------------------------------------------------

    def set_exposure(self, exposure_s: float, repeats: int) -> CameraSettings:
        """Set exposure and averaging, unless they are set so already; returns the settings as read back."""
        # The trigger is that of the rig file.
        asked = CameraSettings(exposure_s=exposure_s, frame_average=repeats)
        if self._asked != asked:
            self._asked = None
            self._read_back = self.require_camera().configure(asked)
            self._asked = asked
        return self._read_back

    def forget_exposure(self) -> None:
        """Set the exposure anew with the next frame: the camera has another one than it was set to."""
        self._asked = None

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
        steps: list[Step] = [("end the guard", partial(self._end_guard, will_retry))]
        if self.camera is not None:
            steps.append(("close the camera", self.camera.close))
        if self.source is not None:
            steps.append(("close the source", self.source.close))
        steps += [(f"close axis {name}", axis.close) for name, axis in self.axes.items()]
        steps.append(("close the ports", self._lines.close))
        if self.simulation is not None:
            steps.append(("end the emulators", self.simulation.stop))
        return run_all(steps)
