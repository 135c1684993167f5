"""Opens the rig of a rig file: real devices, or emulators with a bench behind them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from acquisition.cleanup import Step
from acquisition.errors import AcquisitionError
from acquisition.rig.config import RigConfig, has_own_emulators
from acquisition.rig.guarded import WatchedSource
from acquisition.rig.rig import Rig
from acquisition.screen.observer import Observer
from drivers.camera import Camera
from drivers.motion import MotionAxis
from drivers.sources.manual import Ask, ManualSource
from processing.instrument.model import InstrumentModel
from simulators.rig.model import SCHEME, SimulatorConfig
from simulators.rig.rig import SimulatedRig


def open_rig(config: RigConfig, *, with_camera: bool = True, ask: Ask | None = None) -> Rig:
    """Choose the rig of a rig file: emulators if it has a `simulator` section, real devices otherwise.

    Parameters
    ----------
    config : RigConfig
    with_camera : bool
        False leaves the camera alone.
    ask : callable or None
        Shows the operator what a source without a cable needs and returns True when it is done.

    Returns
    -------
    Rig
        A context manager; its devices are opened on entry.

    Raises
    ------
    AcquisitionError
        A port is an emulator's, and the file has no `simulator` section.

    Examples
    --------
    >>> from acquisition import DEFAULT_RIG, load_rig, open_rig
    >>> with open_rig(load_rig(DEFAULT_RIG), with_camera=False) as rig:
    ...     sorted(rig.axes)
    ['arm', 'psa', 'psg']
    """
    if config.simulator is None:
        for entry in (*config.axes.values(), config.source):
            if (port := getattr(entry, "port", "")).startswith(SCHEME):
                raise AcquisitionError(
                    f"port {port!r} is an emulator, but the rig file has no `simulator` section. Give the device path."
                )
        return Rig(config, with_camera=with_camera, ask=ask)
    return EmulatedRig(config, config.simulator, with_camera=with_camera, ask=ask)


class _Announcer(Observer):
    """Announces to the simulated bench the state of the next exposure."""

    def __init__(self, simulation: SimulatedRig) -> None:
        self._simulation = simulation

    def exposing(self, state: int, retake: int) -> None:
        self._simulation.announce(state, retake)


class EmulatedRig(Rig):
    """A rig whose devices at ports `sim:NAME` are emulators of this process."""

    def __init__(
        self, config: RigConfig, simulator: SimulatorConfig, *, with_camera: bool = True, ask: Ask | None = None
    ) -> None:
        super().__init__(config, with_camera=with_camera, ask=ask)
        self._simulator = simulator
        self.simulation = SimulatedRig(simulator, with_camera=with_camera)

    def start(self) -> str:
        self.simulation.start()
        return ", ".join(self._simulator.ports)

    def open_axis(self, name: str) -> MotionAxis:
        entry = self.config.axes[name]
        self.simulation.connect(name, entry.direction, entry.zero_deg)
        return super().open_axis(name)

    def open_source(self) -> WatchedSource:
        source = super().open_source()
        if isinstance(source.inner, ManualSource):
            self.simulation.uncovered = source.inner.is_on
        return source

    def open_camera(self) -> Camera:
        self._camera_entry = self.config.camera.model_copy(update={"device": self.simulation.camera_device()})
        return super().open_camera()

    def _resolve_port(self, entry: Any) -> Any:
        # A device that is switched by hand has no port.
        if not getattr(entry, "port", "").startswith(SCHEME):
            return entry
        changes = {"port": self.simulation.port(entry.port.removeprefix(SCHEME))}
        # A filter wheel's shutter has a port of its own.
        if getattr(entry, "shutter", None) is not None:
            changes["shutter"] = self._resolve_port(entry.shutter)
        return entry.model_copy(update=changes)

    def show(
        self,
        sample: str,
        wavelength_nm: float | None = None,
        *,
        mode: str | None = None,
        instrument: InstrumentModel | None = None,
        omega_deg: float | None = None,
    ) -> None:
        name = mode or next(iter(self.config.modes))
        truth = self._simulator.truth.get(name)
        if truth is not None or instrument is None:
            instrument = InstrumentModel.load(truth or self.config.modes[name].instrument)
        self.simulation.prepare(sample, instrument, wavelength_nm or self.config.wavelengths_nm[0], omega_deg)

    def observers(self) -> Sequence[Observer]:
        return (_Announcer(self.simulation),)

    def start_guard(self, journal: Path | None = None) -> None:
        # Emulators that end with this process need no guard.
        if not has_own_emulators(self.config):
            super().start_guard(journal)

    @property
    def time_scale(self) -> float:
        return self.simulation.clock.speed

    def _steps_of_closing(self, *, will_retry: bool) -> list[Step]:
        return [*super()._steps_of_closing(will_retry=will_retry), ("end the emulators", self.simulation.stop)]
