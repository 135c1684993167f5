"""OWIS position control units PS10 and PS90 with rotation stages.

Documents: OWIS' libraries ps90.dll (1.0.9.1, 2014, with ps90.h and the example ps90tool.c) and ps10.dll (with
ps10func.cs, 2016). Every command of this driver is a string in both, and on the wire ps90.dll ends it with CR.
The meaning of a letter of ``?ASTAT`` is the result of their GetAxisState, GetMoveState and GetErrorState: ready, off,
one of eleven motions, one of seven errors. They take every letter outside their lists for ready, this driver R alone.
The words of the errors, and what the modes of REF do, come from public copies of the manual. A home counts where it
ended at zero, and its motion was seen (P) or GetRefReady (`?REFST`) answers 1. Speed and limits have units that
are not documented: the rig file says the speed.
Unverified on hardware: everything.
"""

import re
from functools import partial
from typing import ClassVar, Literal

from pydantic import Field

from drivers.clock import Clock
from drivers.errors import CommandRejected, ReplyError, WrongDevice
from drivers.serial_link import LineRegistry, Transcript, agreed, line_framer
from drivers.session_reference import SessionReferenceAxis, SessionReferenceConfig
from drivers.text_line import TextLine

READY = "R"
MOVING = frozenset("TSPFVJWXYCN")
NOT_READY = {"I": "initialized, not ready", "O": "disabled", "U": "not released"}
FAULTS = {
    "L": "disabled at a limit switch",
    "B": "stopped at a brake switch",
    "A": "disabled after an error of the limit switches",
    "M": "disabled after an error of the motion controller",
    "Z": "disabled after a timeout",
    "H": "disabled while the phases of its motor are initialized",
    "E": "disabled after a motion error",
}
STATES = READY + "".join(sorted(MOVING)) + "".join(NOT_READY) + "".join(FAULTS)
INITIALIZED_S = 5.0
_REFERENCE = re.compile("[01]")
_COUNT = re.compile(r"-?\d{1,10}")
_STATES = re.compile(rf"[{STATES}?]{{1,9}}")
# Not a message, which starts with its number.
_VERSION = re.compile(r"(?!\d\d )(?=.*\d)[A-Za-z].*")


class Config(SessionReferenceConfig):
    """An axis of an OWIS unit in a rig file."""

    identified_by: ClassVar[str] = "version"

    kind: Literal["owis"] = "owis"
    axis: int = Field(default=1, ge=1, le=9, description="number of the axis at its unit")
    version: str | None = Field(default=None, description="what the unit answers to ?VERSION")
    counts_per_deg: float = Field(gt=0, description="what the unit counts in a degree: (micro)steps or encoder")
    speed_deg_s: float = Field(gt=0, description="speed of moves as the unit is set, for deadlines")
    acceleration_deg_s2: float = Field(default=100.0, gt=0, description="acceleration as the unit is set")
    home_mode: int = Field(default=4, ge=0, le=7, description="mode of REF; it must end at zero, as 4 does")
    baudrate: int = Field(default=9600, description="bits a second, as the unit is set")

    def place(self) -> str:
        return f"axis {self.axis}"


class OWISAxis(SessionReferenceAxis):
    """One axis of a unit."""

    def __init__(self, name: str, config: Config, line: TextLine, lines: LineRegistry) -> None:
        super().__init__(name, config, lines.clock)
        self.config: Config = config
        self._line, self._lines = line, lines
        asked = f"axis {name} on {config.port} axis {config.axis}"
        version = line.ask("?VERSION", _VERSION)
        if config.version not in (None, version):
            raise WrongDevice(asked, f"{version} answers", "Correct `port` or `version` in the rig file")
        count = agreed(lambda: len(line.ask("?ASTAT", _STATES)))
        if config.axis > count:
            raise WrongDevice(asked, f"the unit has {count} axes", "Correct `axis` in the rig file")
        self.counts_per_deg = config.counts_per_deg
        self.speed_deg_s, self.acceleration_deg_s2 = config.speed_deg_s, config.acceleration_deg_s2
        self._identify(
            model=f"OWIS PS of {count} axes", serial_number="not asked for", firmware=version, address=str(config.axis)
        )

    def _state(self) -> str:
        for _ in range(2):
            states = self._line.ask("?ASTAT", _STATES)
            if len(states) >= self.config.axis and states[self.config.axis - 1] != "?":
                return states[self.config.axis - 1]
        raise ReplyError(f"axis {self.name}, state", f"unknown in {states!r}", "Check the cable; switch the unit off")

    def _send(self, command: str) -> None:
        self._line.send(command)

    def _make_ready(self) -> None:
        """Initialize an axis that is not ready, which switches its motor on, and wait until it is."""
        axis = self.config.axis
        if self._state() == READY and self._state() == READY:
            return
        self._send(f"INIT{axis}")
        give_up_s = self.clock.now_s() + INITIALIZED_S
        while (state := self._state()) != READY:
            if self.clock.now_s() > give_up_s:
                words = FAULTS.get(state) or NOT_READY.get(state) or f"state {state}"
                raise CommandRejected(f"axis {self.name}, INIT{axis}", words, "Look at the stage and its switches")
            self.clock.sleep_s(0.02)

    def _do_read_counts(self) -> int:
        return int(self._line.ask(f"?CNT{self.config.axis}", _COUNT))

    def _do_is_moving(self) -> bool:
        # One garbled letter must not end a motion.
        states = [self._state() for _ in range(2)]
        self._saw_motion = self._saw_motion or states == ["P", "P"]
        return any(state in MOVING for state in states)

    def _homing_is_proved(self, counts: float, tolerance: float) -> bool:
        if abs(counts) > tolerance:
            self._lost = f"homing ended at {counts:g} counts instead of zero: change home_mode"
            return False
        # A unit that was just switched on counts zero as well; a short way home may be over before the first look.
        question = f"?REFST{self.config.axis}"
        return self._saw_motion or agreed(lambda: self._line.ask(question, _REFERENCE)) == "1"

    def _do_start_move(self, counts: float) -> None:
        self._make_ready()
        self._begin_moving()
        axis = self.config.axis
        with self._line.link.lock:
            for command in (f"ABSOL{axis}", f"PSET{axis}={round(counts)}", f"PGO{axis}"):
                self._send(command)

    def _do_start_home(self) -> None:
        self._make_ready()
        self._begin_homing()
        self._send(f"REF{self.config.axis}={self.config.home_mode}")

    def _do_stop(self) -> None:
        self._give_up_homing()
        self._send(f"STOP{self.config.axis}")

    def _do_check_fault(self) -> None:
        state = self._state()
        if state in FAULTS and self._state() == state:
            self._give_up_homing()
            raise CommandRejected(f"axis {self.name}, state", FAULTS[state], "Free the stage; a move initializes it")

    def _do_warnings(self) -> list[str]:
        words = self._reference_warnings()
        if (state := self._state()) in NOT_READY:
            words.append(NOT_READY[state])
        return words


class OWISLine(TextLine):
    """The port of one unit, shared by its axes."""

    controller, end = "OWIS PS", "\r"

    def __init__(self, config: Config, clock: Clock, transcript: Transcript | None) -> None:
        super().__init__(config, clock, transcript, line_framer, baudrate=config.baudrate, reply_s=1.0)


def open(name: str, config: Config, lines: LineRegistry) -> OWISAxis:
    """Open one axis; asks for version and states and moves nothing."""
    with lines.taken(config.port, OWISLine, partial(OWISLine, config, lines.clock)) as line:
        return OWISAxis(name, config, line, lines)
