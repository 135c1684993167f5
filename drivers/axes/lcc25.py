"""Thorlabs LCC25: the voltage at a liquid-crystal retarder, as an axis of volts with named states.

115200 8N1, the line of `drivers.prompt_line`: an empty line, which wakes it, `*idn?`, `volt1?`, `volt1=1.5300` (volts
RMS, 0 to 25), `mode?` (1 for voltage 1, 2 for voltage 2, 0 for a change between the two), `enable?`. The driver uses
voltage 1.

Documents: Thorlabs' serial example (github.com/Thorlabs/Light_Control_and_Manipulation_Examples, C#/LCC25) for the
line, the empty command, `*idn?` and `volt1`; Thorlabs' library LCC25CommandLib for every command, and its file
LCC25_COMMAND_LIB.py for limits and for the numbers of modes and output. The library reads both answers as numbers: it
ran against the emulator. The controller does not see the crystal: `settle_s` is the time that it takes.
Unverified on hardware: everything.
"""

import math
import re
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from drivers.errors import CommandRejected, WrongDevice
from drivers.motion import AxisConfig, MotionAxis
from drivers.prompt_line import PromptLine, prompt_framer
from drivers.serial_link import LineRegistry, SerialLink

BAUDRATE = 115200
HIGHEST_V = 25.0
ALTERNATES, VOLTAGE_1 = 0, 1
_VOLTS = re.compile(r"\d+(?:\.\d+)?")
_MODE = re.compile(r"[012]")
_FLAG = re.compile(r"[01]")


class Config(AxisConfig):
    """A liquid-crystal retarder in a rig file; all its positions are volts."""

    identified_by: ClassVar[str] = "identity"
    unit = "V"

    kind: Literal["lcc25"] = "lcc25"
    identity: str | None = Field(default=None, description="what the controller answers to *idn?")
    states: dict[str, Annotated[float, Field(ge=0, le=HIGHEST_V)]] = Field(
        default={}, description="names of voltages, such as {quarter: 1.53, half: 2.2}; a plan may use them"
    )
    settle_s: float = Field(default=0.3, ge=0, le=60, description="time that the crystal takes after a change")
    tolerance_deg: float = Field(default=0.002, gt=0, le=1, description="largest allowed distance from the target, V")

    def named_states(self) -> Mapping[str, float]:
        return self.states


class LCC25Axis(MotionAxis):
    """Voltage 1 of a controller, and whether it is put out."""

    can_stop_a_move = False

    def __init__(self, name: str, config: Config, link: SerialLink, lines: LineRegistry) -> None:
        super().__init__(name, config, lines.clock)
        self.config: Config = config
        self._lines = lines
        asked = f"liquid-crystal controller on {config.port}"
        self._line = PromptLine(link, asked, config.reply_s or 1.0)
        # Thorlabs' example: it takes commands after an empty one, which it refuses.
        self._line.tell("")
        identity = self._line.ask("*idn?")
        if "LCC25" not in identity.upper() or config.identity not in (None, identity):
            raise WrongDevice(
                f"axis {name}, {asked}", f"it answers {identity!r}", "Correct `port` or `identity` in the rig file"
            )
        self.speed_deg_s = self.acceleration_deg_s2 = math.inf
        self._device_min_deg, self._device_max_deg = 0.0, HIGHEST_V
        self._rests_from_s = -math.inf
        self._identify(
            model=identity,
            serial_number="not told by the protocol",
            firmware="not told by the protocol",
            address="voltage 1",
        )

    def move_time_s(self, distance_deg: float) -> float:
        """Time that the crystal takes, whatever the change."""
        return self.config.settle_s if distance_deg else 0.0

    def _do_read_counts(self) -> float:
        """Volts at the crystal."""
        mode = int(self._line.ask("mode?", _MODE))
        if self._line.ask("enable?", _FLAG) == "0":
            return 0.0
        if mode == ALTERNATES:
            raise CommandRejected(
                f"axis {self.name}, voltage", "it changes between two voltages", "Choose Voltage 1 at its panel"
            )
        return float(self._line.ask(f"volt{mode}?", _VOLTS))

    def _do_is_homed(self) -> bool:
        """A voltage needs no reference."""
        return True

    def _do_is_moving(self) -> bool:
        return self.clock.now_s() < self._rests_from_s

    def _do_start_move(self, counts: float) -> None:
        for command in (f"volt1={counts:.4f}", f"mode={VOLTAGE_1}", "enable=1"):
            self._line.tell(command)
        self._rests_from_s = self.clock.now_s() + self.config.settle_s

    def _do_start_home(self) -> None:
        """There is nothing to do."""

    def _do_stop(self) -> None:
        """A voltage that was set is there at once."""

    def _do_check_fault(self) -> None:
        """The controller tells no faults."""

    def _do_warnings(self) -> list[str]:
        return [] if self._line.ask("enable?", _FLAG) == "1" else ["its output is off"]


def open(name: str, config: Config, lines: LineRegistry) -> LCC25Axis:
    """Open the axis; asks who it is and changes nothing."""
    with lines.link(config, BAUDRATE, prompt_framer) as link:
        return LCC25Axis(name, config, link, lines)
