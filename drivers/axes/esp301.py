"""Newport ESP301 and ESP300 with rotation stages.

Facts: Newport's ESP300 manual 3.4 and the public drivers of odemis, pymeasure and instrumentkit. Replies carry
neither address nor command, so only their order and their form tell whose they are. The controller cannot say
whether an axis is homed. Use RS-232: USB is reported unusable on Linux.
"""

import re
from functools import partial
from typing import ClassVar, Literal

from pydantic import Field

from drivers.axis_types import stage_limit
from drivers.clock import Clock
from drivers.errors import CommandRejected, ReplyError, WrongDevice
from drivers.serial_link import LineRegistry, Transcript, agreed, line_framer
from drivers.session_reference import SessionReferenceAxis, SessionReferenceConfig
from drivers.text_line import TextLine

ERRORS = {6: "no such command", 7: "parameter out of range", 9: "axis out of range", 37: "axis number missing"}
AXIS_ERRORS = {
    4: "hardware limit",
    5: "hardware limit",
    6: "software limit",
    7: "software limit",
    13: "motor not enabled",
    20: "homing aborted",
    30: "not allowed during homing",
}
DEGREE = 7
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_FLAG = re.compile(r"[01]")
_INTEGER = re.compile(r"\d{1,4}")
_VERSION = re.compile(r"ESP30\d.*", re.IGNORECASE)
_TEXT = re.compile(r"[^,]+,\s*[^,]+|UNKNOWN.*", re.IGNORECASE)


class Config(SessionReferenceConfig):
    """An ESP301 axis in a rig file; its unit must be degrees.

    `stage_id` is compared with the start of what ``ID?`` answers (stage model and serial number).
    """

    identified_by: ClassVar[str] = "stage_id"

    kind: Literal["esp301"] = "esp301"
    axis: int = Field(default=1, ge=1, le=3, description="number of the axis at its controller")
    stage_id: str | None = Field(default=None, description="name of the stage that the controller reports")
    home_mode: int = Field(default=1, ge=0, le=6, description="mode of OR")
    baudrate: int = Field(default=19_200, description="bits a second, as the controller is set")
    rtscts: bool = Field(default=True, description="whether the wires RTS and CTS hold back who sends too fast")

    def place(self) -> str:
        return f"axis {self.axis}"


class ESP301Line(TextLine):
    """The port of one controller, shared by its axes."""

    controller, end, what_to_check = "ESP301", "\r", "Check power, cable, baud rate and RTS/CTS"

    def __init__(self, config: Config, clock: Clock, transcript: Transcript | None) -> None:
        super().__init__(
            config, clock, transcript, line_framer, baudrate=config.baudrate, rtscts=config.rtscts, reply_s=2.0
        )
        # The controller has one error memory for all axes, and reading takes out: each axis's own are kept here.
        self._errors: dict[int, list[int]] = {}

    def take_errors(self, axis: int) -> list[int]:
        """Empty the controller's error memory and return what concerns an axis, oldest first.

        Errors of other axes are stored for them. An error without an axis is of the last command, of the caller.
        """
        with self.link.lock:
            for _ in range(20):
                code = int(self.ask("TE?", _INTEGER))
                if code == 0:
                    break
                self._errors.setdefault(code // 100 or axis, []).append(code)
            return self._errors.pop(axis, [])


class ESP301Axis(SessionReferenceAxis):
    """One axis of a controller."""

    def __init__(self, name: str, config: Config, line: ESP301Line, lines: LineRegistry) -> None:
        super().__init__(name, config, lines.clock)
        self.config: Config = config
        self._line, self._lines = line, lines
        version = line.ask("VE?", _VERSION)
        stage = line.ask(f"{config.axis}ID?", _TEXT)
        label = f"axis {name} on {config.port} axis {config.axis}"
        if config.stage_id is not None and not stage.startswith(config.stage_id):
            raise WrongDevice(f"{label}, stage {config.stage_id}", f"found {stage!r}", "Correct it in the rig file")
        unit = int(line.ask(f"{config.axis}SN?", _INTEGER))
        if unit != DEGREE:
            raise WrongDevice(f"{label}, unit", f"unit {unit}, not {DEGREE} (degree)", "Set it with the front panel")
        self.speed_deg_s = self._constant("VA?")
        self.acceleration_deg_s2 = self._constant("AC?")
        if self.speed_deg_s <= 0 or self.acceleration_deg_s2 <= 0:
            raise ReplyError(f"{label}, speed", f"{self.speed_deg_s}, {self.acceleration_deg_s2}", "Set VA and AC")
        self._device_min_deg = self._limit("SL?")
        self._device_max_deg = self._limit("SR?")
        model, _, serial_number = stage.partition(",")
        self._identify(
            model=f"{version.split()[0]} stage {model.strip()}",
            serial_number=serial_number.strip(),
            firmware=" ".join(version.split()[1:]),
            address=str(config.axis),
        )

    def _number(self, command: str) -> float:
        return float(self._line.ask(f"{self.config.axis}{command}", _NUMBER))

    def _constant(self, command: str) -> float:
        return agreed(lambda: self._number(command))

    def _limit(self, command: str) -> float | None:
        return stage_limit(self._constant(command))

    def _raise_errors(self, request: str) -> None:
        codes = self._line.take_errors(self.config.axis)
        if codes:
            words = [
                f"error {code}: {(AXIS_ERRORS.get(code % 100) if code >= 100 else ERRORS.get(code)) or 'see manual'}"
                for code in codes
            ]
            self._give_up_homing()
            raise CommandRejected(f"axis {self.name}, {request}", ", ".join(words), "Look at the controller's display")

    def _command(self, command: str) -> None:
        axis = self.config.axis
        with self._line.link.lock:
            self._line.take_errors(axis)
            # The motor is off at power-up; a move would only leave an error behind.
            if self._line.ask(f"{axis}MO?", _FLAG) == "0":
                self._line.send(f"{axis}MO")
            self._line.send(f"{axis}{command}")
            self._raise_errors(command)

    def _homing_is_proved(self, counts: float, tolerance: float) -> bool:
        # The controller took OR without an error; a short way home may be over before the first look.
        return self._saw_motion or abs(counts) <= tolerance

    def _do_read_counts(self) -> float:
        return self._number("TP?")

    def _do_is_moving(self) -> bool:
        # One garbled digit must not end a motion.
        answers = [self._line.ask(f"{self.config.axis}MD?", _FLAG) for _ in range(2)]
        self._saw_motion = self._saw_motion or answers == ["0", "0"]
        return "0" in answers

    def _do_start_move(self, counts: float) -> None:
        self._begin_moving()
        self._command(f"PA{counts:.5f}")

    def _do_start_home(self) -> None:
        self._begin_homing()
        self._command(f"OR{self.config.home_mode}")

    def _do_stop(self) -> None:
        self._give_up_homing()
        self._line.send(f"{self.config.axis}ST")

    def _do_check_fault(self) -> None:
        self._raise_errors("state")

    def _do_warnings(self) -> list[str]:
        words = self._reference_warnings()
        if self._line.ask(f"{self.config.axis}MO?", _FLAG) == "0":
            words.append("motor off")
        return words


def open(name: str, config: Config, lines: LineRegistry) -> ESP301Axis:
    """Open one axis; reads its identity, limits and speed and moves nothing."""
    with lines.taken(config.port, ESP301Line, partial(ESP301Line, config, lines.clock)) as line:
        return ESP301Axis(name, config, line, lines)
