"""A stage of Micro-Manager as a rotary axis, through the core of this process (pymmcore-plus).

Facts: the interface of MMCore. It knows stages of one dimension in micrometres, so the rig file says how many of them a
degree is; it tells neither speed nor limits, whether the stage is homed, nor what is wrong with it. A stop waits for an
adapter that holds its device's lock while it moves. The guard beside a run has a core of its own, which reaches the
stage only if `configuration` can be loaded twice. Tried with stages written in Python and with the stage of DemoCamera.
"""

from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from drivers.errors import PortNotFound, WrongDevice
from drivers.micromanager import NOT_TOLD, asking, loaded_devices, running_core
from drivers.serial_link import LineRegistry
from drivers.session_reference import SessionReferenceAxis, SessionReferenceConfig


class Config(SessionReferenceConfig):
    """A stage of Micro-Manager in a rig file."""

    identified_by: ClassVar[str] = "device"

    kind: Literal["mmcore"] = "mmcore"
    port: str = Field(default="micromanager", description="serial port, or sim:NAME for an emulator")
    device: str = Field(description="label of the stage in the core")
    configuration: Path | None = Field(
        default=None, description="configuration file that is loaded if the core does not hold the device yet"
    )
    units_per_deg: float = Field(default=1.0, gt=0, description="what the core calls micrometres, per degree")
    speed_deg_s: float = Field(gt=0, description="of moves and homing, for deadlines: the core does not tell it")
    acceleration_deg_s2: float = Field(default=100.0, gt=0, description="acceleration, degrees a second squared")

    def place(self) -> str:
        return f"device {self.device}"


class MMCoreAxis(SessionReferenceAxis):
    """One stage."""

    def __init__(self, name: str, config: Config, core: Any, lines: LineRegistry) -> None:
        super().__init__(name, config, lines.clock)
        self.config: Config = config
        self._core = core
        request = f"axis {name}, find the stage {config.device}"
        if config.device not in core.getLoadedDevices():
            raise PortNotFound(request, f"the core holds {loaded_devices(core)}", "Correct `device` or `configuration`")
        kind = core.getDeviceType(config.device).name
        if kind not in ("Stage", "StageDevice"):
            raise WrongDevice(request, f"it is of the type {kind}", "Only stages of one dimension are axes")
        self.counts_per_deg = config.units_per_deg
        self.speed_deg_s, self.acceleration_deg_s2 = config.speed_deg_s, config.acceleration_deg_s2
        with asking(request):
            self._identify(
                model=f"{core.getDeviceLibrary(config.device)} {core.getDeviceName(config.device)}",
                serial_number=NOT_TOLD,
                firmware=core.getVersionInfo(),
                address=config.device,
            )

    def _do_read_counts(self) -> float:
        with asking(f"axis {self.name}, read position"):
            return float(self._core.getPosition(self.config.device))

    def _do_is_moving(self) -> bool:
        with asking(f"axis {self.name}, state"):
            return bool(self._core.deviceBusy(self.config.device))

    def _do_start_move(self, counts: float) -> None:
        self._begin_moving()
        with asking(f"axis {self.name}, move to {counts:g}"):
            self._core.setPosition(self.config.device, counts)

    def _do_start_home(self) -> None:
        self._begin_homing()
        with asking(f"axis {self.name}, home", "Not every adapter can home: set the zero in Micro-Manager"):
            self._core.home(self.config.device)
        # A command that did not arrive is an exception here, so the call itself proves it.
        self._saw_motion = True

    def _do_stop(self) -> None:
        self._give_up_homing()
        with asking(f"axis {self.name}, stop"):
            self._core.stop(self.config.device)

    def _do_check_fault(self) -> None:
        """The core knows no faults: a call that fails is one."""

    def _do_warnings(self) -> list[str]:
        return self._reference_warnings()

    def _do_close(self) -> None:
        """The core stays: it may be another program's part as well."""


def open(name: str, config: Config, lines: LineRegistry) -> MMCoreAxis:
    """Take a stage from the core; moves nothing."""
    core = running_core(f"axis {name}, open", config.configuration, config.device)
    return MMCoreAxis(name, config, core, lines)
