"""OptoSigma (Sigma Koki) GSC-01, GSC-02 and other controllers with SHOT commands, and rotation stages.

Documents: Sigma Koki's "GSC-01 User's Manual", sixth edition (2017.9), and "GSC-02 User's Manual", seventh edition
(2019.4), chapters 3; also the public drivers elerac/optosigma, pysigmakoki and PyOptoSigma. Moves are relative, because
a GSC-02 has no others. The controller tells neither speed nor limits, nor whether it is homed, and it takes no move
while one of its axes moves: one axis of it can be in a rig. Other SHOT controllers are taken for a GSC-01.
Unverified on hardware: everything; that a GSC-01 keeps the result of a command until the next.
"""

import re
from functools import partial
from typing import ClassVar, Literal, NamedTuple

from pydantic import Field

from drivers.clock import Clock
from drivers.errors import CommandRejected, WrongDevice
from drivers.serial_link import LineRegistry, Transcript, line_framer
from drivers.session_reference import SessionReferenceAxis, SessionReferenceConfig
from drivers.text_line import TextLine

# Pulses a second, and milliseconds from start to this speed: the homing of a GSC-01 and a GSC-02.
HOMING_PPS = 5000
# The sign stands apart from its digits, with blanks and nothing else between.
_STATUS = re.compile(r" *([+-]? *\d+ *, *)+[XK] *, *[KLMW] *, *[BR] *")
_VERSION = re.compile(r"(?!OK$|NG$)[\w .-]+")
# At a limit switch: the first axis, the second, both.
_AT_LIMIT = {"L": (1,), "M": (2,), "W": (1, 2)}


class Config(SessionReferenceConfig):
    """A SHOT controller's axis in a rig file."""

    identified_by: ClassVar[str] = "firmware"

    kind: Literal["gsc"] = "gsc"
    axis: int = Field(default=1, ge=1, le=4, description="number of the axis at its controller")
    firmware: str | None = Field(default=None, description="what the controller answers to ?:V")
    pulses_per_deg: float = Field(default=400.0, gt=0, description="pulses of a degree; 400 for OSMS-60YAW")
    speed_pps: float = Field(default=5000.0, gt=0, description="speed of moves as set, pulses a second, for deadlines")
    acceleration_s: float = Field(default=0.2, gt=0, description="time to that speed, as set")
    home_direction: Literal["+", "-"] | None = Field(
        default=None, description="way to the origin: for a GSC-02, and for it alone"
    )
    baudrate: int = Field(default=9600, description="bits a second, as the controller is set")
    rtscts: bool = Field(default=True, description="whether the wires RTS and CTS hold back who sends too fast")

    def place(self) -> str:
        return f"axis {self.axis}"


class ShotStatus(NamedTuple):
    """Answer to ``Q:``: pulses of each axis, last command accepted, limit switches, moving."""

    pulses: list[int]
    accepted: bool
    at_limit: str
    busy: bool


class GSCAxis(SessionReferenceAxis):
    """The axis of a controller."""

    def __init__(self, name: str, config: Config, line: TextLine, lines: LineRegistry) -> None:
        super().__init__(name, config, lines.clock)
        self.config: Config = config
        self._line, self._lines = line, lines
        label = f"axis {name} on {config.port} axis {config.axis}"
        firmware = line.ask("?:V", _VERSION)
        if config.firmware not in (None, firmware):
            raise WrongDevice(label, f"its firmware is {firmware}", "Correct `port` or `firmware` in the rig file")
        count = len(self._status().pulses)
        if config.axis > count:
            raise WrongDevice(label, f"the controller has {count} axes", "Correct `axis` in the rig file")
        self.counts_per_deg = config.pulses_per_deg
        self.speed_deg_s = config.speed_pps / config.pulses_per_deg
        self.acceleration_deg_s2 = self.speed_deg_s / config.acceleration_s
        # Of all controllers a GSC-02 alone is told the way home, and drives at a letter without a colon.
        self._drive = "G" if config.home_direction else "G:"
        self._home_speed_deg_s = HOMING_PPS / config.pulses_per_deg
        self._identify(
            model=f"SHOT controller of {count} axes",
            serial_number="not told by the protocol",
            firmware=firmware,
            address=str(config.axis),
        )

    def _status(self) -> ShotStatus:
        *pulses, acknowledgement, at_limit, busy = self._line.ask("Q:", _STATUS).replace(" ", "").split(",")
        return ShotStatus([int(text) for text in pulses], acknowledgement == "K", at_limit, busy == "B")

    def _command(self, *commands: str) -> None:
        """Send commands and ask after each whether it was accepted; some controllers also answer OK or NG."""
        for command in commands:
            with self._line.link.lock:
                self._line.send(command)
                is_accepted = self._status().accepted
            if not is_accepted:
                self._give_up_homing()
                raise CommandRejected(
                    f"axis {self.name}, {command}", "the controller refuses it", "Is the motor free, or at a limit?"
                )

    def _do_read_counts(self) -> int:
        return self._status().pulses[self.config.axis - 1]

    def _do_is_moving(self) -> bool:
        # One garbled letter must not end a motion.
        busy = [self._status().busy for _ in range(2)]
        self._saw_motion = self._saw_motion or all(busy)
        return any(busy)

    def _homing_is_proved(self, counts: float, tolerance: float) -> bool:
        # The controller took H; a short way home may be over before the first look.
        return self._saw_motion or abs(counts) <= tolerance

    def _do_start_move(self, counts: float) -> None:
        way = round(counts) - int(self._read_confirmed()[0])
        self._begin_moving()
        if way:
            self._command(f"M:{self.config.axis}{'+' if way > 0 else '-'}P{abs(way)}", self._drive)

    def _do_start_home(self) -> None:
        self._begin_homing()
        self._command(f"H:{self.config.axis}{self.config.home_direction or ''}")

    def _do_stop(self) -> None:
        # While it looks for the origin, a GSC-02 obeys only what is meant for all axes.
        whom = "W" if self._homing and self.config.home_direction else self.config.axis
        self._give_up_homing()
        self._line.send(f"L:{whom}")

    def _do_check_fault(self) -> None:
        """The controller tells no faults."""

    def _do_warnings(self) -> list[str]:
        words = self._reference_warnings()
        if self.config.axis in _AT_LIMIT.get(self._status().at_limit, ()):
            words.append("stopped at a limit switch")
        return words


class GSCLine(TextLine):
    """The port of one controller, for one axis."""

    controller, end, what_to_check = "SHOT controller", "\r\n", "Check power, cable, baud rate and RTS/CTS"
    axis = 0

    def __init__(self, config: Config, clock: Clock, transcript: Transcript | None) -> None:
        super().__init__(
            config, clock, transcript, line_framer, baudrate=config.baudrate, reply_s=1.0, rtscts=config.rtscts
        )


def open(name: str, config: Config, lines: LineRegistry) -> GSCAxis:
    """Open the axis; asks for firmware and status and moves nothing."""
    with lines.taken(config.port, GSCLine, partial(GSCLine, config, lines.clock)) as line:
        if line.axis not in (0, config.axis):
            raise WrongDevice(
                f"axis {name} on {config.port} axis {config.axis}",
                f"axis {line.axis} of this controller is in use, and it moves one at a time",
                "Give each axis a controller of its own",
            )
        line.axis = config.axis
        return GSCAxis(name, config, line, lines)
