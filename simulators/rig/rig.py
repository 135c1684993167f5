"""The simulated rig: starts the emulators that a rig file describes and puts the bench behind them.

The emulators speak the real protocols; this module is what stands behind them on a real table: the sample that the
operator places, the filter in the source, and light that falls on the sensor while the axes stand where they truly
stand.
"""

import contextlib
import math
import threading
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from processing.instrument.model import InstrumentModel
from processing.yaml_file import ConfigError
from simulators.bench.bench import SimulatedBench
from simulators.bench.scene import Scene
from simulators.camera.exposure import ExposureInfo
from simulators.camera.gige_camera import GigeCamera
from simulators.camera.pixel_stamp import stamp
from simulators.clock import FastClock, patient_clock
from simulators.rig.controller_kinds import served_kinds
from simulators.rig.model import SimulatorConfig
from simulators.serial.emulator import Emulator
from simulators.serial.reply_faults import FaultSchedule, parse_fault
from simulators.serial.serve_options import ServeOptions
from simulators.serial.served_port import ServedPort
from simulators.serial.tcp_port import port_for

#: Exposure indices of one state: tries of it come this far apart.
RETAKE_STRIDE = 1_000_000


class SimulatedRig:
    """Emulators of a rig and the bench behind them.

    `prepare` places a sample; `announce` says which exposure comes, so that noise belongs to the state and not to
    the number of exposures taken so far (a resumed run equals an uninterrupted one).
    """

    def __init__(self, config: SimulatorConfig, *, with_camera: bool = True) -> None:
        self.config = config
        self.clock = FastClock(config.clock_speed, base=patient_clock())
        self.emulators: dict[str, Emulator] = {}
        self.bench: SimulatedBench | None = None
        self.camera: GigeCamera | None = None
        #: A source without a cable is covered by the operator: False while it is covered.
        self.uncovered: Callable[[], bool] = lambda: True
        self._with_camera = with_camera
        self.served_ports: dict[str, ServedPort] = {}
        self._user_angle: dict[str, Callable[[float], float]] = {}
        self._next_index = 0
        self._started_s = time.monotonic()
        self._lock = threading.Lock()

    def start(self) -> None:
        """Start every emulator. Raises ConfigError for a kind or an axis that there is not."""
        for name, port in self.config.ports.items():
            self.emulators[name] = self._emulator(name)
            self.served_ports[name] = port_for(self.emulators[name])
            for text in port.faults:
                self.emulators[name].faults.add(parse_fault(text))
        for name, axis in self.config.axes.items():
            count = len(self.emulators[axis.port].axes) if axis.port in self.emulators else 0
            if axis.index >= count:
                raise ConfigError(
                    f"simulator.axes.{name}: port {axis.port!r} has no axis of index {axis.index} (from 0; axes there: "
                    f"{count}). Correct `index`, or `axes` of the port under `simulator.ports`."
                )
        if self._with_camera:
            self._start_camera()

    def _emulator(self, name: str) -> Emulator:
        port = self.config.ports[name]
        kinds = served_kinds()
        if port.kind not in kinds:
            listing = ", ".join(kinds)
            raise ConfigError(f"simulator.ports.{name}: there is no emulator of kind {port.kind!r}, only {listing}")
        options = ServeOptions(
            axes=port.axes,
            limits_deg=port.limits_deg,
            speed_deg_s=port.speed_deg_s,
            acceleration_deg_s2=port.acceleration_deg_s2,
            homed=port.homed,
            clock=self.clock,
            faults=FaultSchedule(seed=self.config.seed),
        )
        try:
            return kinds[port.kind](options)
        except ValueError as error:
            raise ConfigError(f"simulator.ports.{name}: {error}") from error

    def stop(self) -> None:
        """End the emulators; the first failure is raised after all were tried."""
        with contextlib.ExitStack() as stack:
            for port in self.served_ports.values():
                stack.callback(port.close)
            if self.camera is not None:
                stack.callback(self._stop_camera)
        self.served_ports.clear()

    def _start_camera(self) -> None:
        config = self.config
        self.camera = GigeCamera(
            "SIM-1",
            config.columns,
            config.rows,
            self.expose,
            description=config.camera,
            bits=config.detector.bits or 12,
            lost_ratio=config.packet_loss,
            address=config.camera_address,
            wait_s=config.camera_wait_s,
            elsewhere=True,
        )
        self.camera.start()

    def _stop_camera(self) -> None:
        camera, self.camera = self.camera, None
        if camera is not None:
            camera.stop()
            camera.check()

    def camera_device(self) -> str:
        """Value of `device`, as in the rig file of a real camera."""
        return self.camera.address if self.camera is not None else self.config.camera_address

    # --- what acquisition asks ---------------------------------------------------------------------------

    def port(self, name: str) -> str:
        """Device path of an emulated port. Raises ConfigError if there is none of that name."""
        if name not in self.served_ports:
            listing = ", ".join(sorted(self.served_ports))
            raise ConfigError(f"port sim:{name}: `simulator.ports` has {listing}")
        return self.served_ports[name].path

    def connect(self, axis: str, direction: int, zero_deg: float) -> None:
        """Tell how the rig file turns this axis's angle into the user's; the truth follows the same zero."""
        if axis not in self.config.axes:
            raise ConfigError(f"simulator.axes: axis {axis!r} of the rig is not there")
        self._user_angle[axis] = lambda device_deg: direction * (device_deg - zero_deg)

    def prepare(
        self, sample: str, instrument: InstrumentModel, wavelength_nm: float, omega_deg: float | None = None
    ) -> None:
        """Place a sample, put in the optics and the filter, as an operator does between captures.

        With `omega_deg` the scene is computed for that arm angle now, instead of in the first exposure there.
        """
        if sample not in self.config.samples:
            listing = ", ".join(sorted(self.config.samples))
            raise ConfigError(f"sample {sample!r}: the simulated rig has {listing}")
        scene = Scene.load(self.config.samples[sample])
        with self._lock:
            if self.bench is None:
                self.bench = self._new_bench(scene, instrument, wavelength_nm)
            else:
                self.bench.put(scene, instrument, wavelength_nm)
            if omega_deg is not None:
                self.bench.look(omega_deg)

    def announce(self, index: int, retake: int = 0) -> None:
        """The next exposure is that of this state."""
        with self._lock:
            self._next_index = index + RETAKE_STRIDE * retake

    def true_angles_deg(self) -> dict[str, float]:
        """Where the optics truly stand, as user angles."""
        angles = {}
        for name, axis in self.config.axes.items():
            device_deg = self.emulators[axis.port].true_deg(axis.index)
            angles[name] = self._user_angle.get(name, float)(device_deg)
        return angles

    def light(self) -> float:
        """Relative light on the sample now, 0 to 1; without a shutter or LED driver it is always 1."""
        wavelength_nm = math.nan if self.bench is None else self.bench.wavelength_nm
        return self.uncovered() * math.prod(e.light_at(wavelength_nm) for e in self.emulators.values())

    def expose(self, info: ExposureInfo) -> NDArray[np.uint16]:
        """Counts (rows, columns) of the camera's region in an exposure that happens now."""
        # Frames are stamped with real time, which motors on a busy machine do not keep.
        time_s = (time.monotonic() - self._started_s) * self.config.clock_speed
        angles = self.true_angles_deg()
        light = self.light()
        with self._lock:
            index = self._next_index
            self._next_index += 1
            if self.bench is None:
                # No sample is placed: the camera looks into the dark.
                return np.zeros((info.height, info.width), dtype=np.uint16)
            counts = info.region_of(self.bench.expose(angles, info.exposure_s, index, light=light, time_s=time_s))
        if self.config.stamp:
            stamp(counts, [angles[name] for name in sorted(angles)], bits=self.config.detector.bits or 12)
        return counts

    def _new_bench(self, scene: Scene, instrument: InstrumentModel, wavelength_nm: float) -> SimulatedBench:
        config = self.config
        return SimulatedBench(
            scene,
            instrument,
            wavelength_nm,
            rows=config.rows,
            columns=config.columns,
            detector=config.detector,
            flux_e_per_s=config.flux_e_per_s,
            dark_current_e_per_s=config.dark_current_e_per_s,
            seed=config.seed,
            effects=config.effects,
        )
