"""Newport SMC100CC/PP and the CONEX controllers that share its commands (CONEX-CC, CONEX-PP, CONEX-AGP).

Facts: Newport's SMC100CC manual and the public drivers of QMI, yaqd and pymodaq. The state word of `TS` is trusted,
not the name of a command. Unverified on hardware: `ID?` (stage identifier) on every model of the family, and CONEX-
PR50CC as a member of it.
"""

import re
from functools import partial
from typing import ClassVar, Literal

from pydantic import Field

from drivers.clock import Clock
from drivers.errors import CommandRejected, DeviceError, NotHomedError, ReplyError, ReplyTimeout, WrongDevice
from drivers.motion import AxisConfig, MotionAxis
from drivers.serial_link import ControllerLine, LineRegistry, Transcript, agreed, line_framer
from drivers.unmarked_replies import ask

ERRORS = {
    "A": "unknown message or bad address",
    "B": "bad address",
    "C": "parameter missing or out of range",
    "D": "not allowed",
    "E": "home sequence already started",
    "F": "stage unknown",
    "G": "displacement out of limits",
    "H": "not allowed in NOT REFERENCED",
    "I": "not allowed in CONFIGURATION",
    "J": "not allowed in DISABLE",
    "K": "not allowed in READY",
    "L": "not allowed in HOMING",
    "M": "not allowed in MOVING",
    "N": "position out of software limit",
    "S": "communication timeout",
    "U": "EEPROM error",
    "V": "error during execution",
    "W": "not for PP versions",
    "X": "not for CC versions",
}
# Index from the left of the 16-bit fault word.
FAULTS = {
    6: "over 80 W",
    7: "DC voltage low",
    8: "wrong stage",
    9: "homing timeout",
    10: "following error",
    11: "short circuit",
    12: "RMS current",
    13: "peak current",
    14: "positive end of run",
    15: "negative end of run",
}
NOT_REFERENCED = range(0x0A, 0x12)
CONFIGURATION = 0x14
HOMING = (0x1E, 0x1F)
MOVING = 0x28
READY = range(0x32, 0x36)
DISABLE = range(0x3C, 0x3F)
JOGGING = (0x46, 0x47)
STATES = frozenset((*NOT_REFERENCED, CONFIGURATION, *HOMING, MOVING, *READY, *DISABLE, *JOGGING))

# After RS the controller restarts and is silent; yaqd-newport allows 5 s.
RESTART_S = 10.0
_NUMBER = re.compile(r"[+-]?\d+(\.\d*)?([eE][+-]?\d+)?")
_KNOWN = ("SMC100", "CONEX")


class Config(AxisConfig):
    """An SMC100 or CONEX axis in a rig file; its unit must be degrees (a rotation stage).

    The protocol shows no serial number: name a CONEX by its ``/dev/serial/by-id`` path, and any stage by
    `stage_id`, which is compared with the start of what ``ID?`` answers.
    """

    identified_by: ClassVar[str] = "stage_id"

    kind: Literal["smc100"] = "smc100"
    address: int = Field(default=1, ge=1, le=31, description="address on the line")
    stage_id: str | None = Field(default=None, description="name of the stage that the controller reports")
    baudrate: int = Field(default=57_600, description="57600 for SMC100, 921600 for CONEX")
    speed_deg_s: float | None = Field(
        default=None, gt=0, description="speed of a CONEX-AGP, which tells none; for deadlines"
    )

    def place(self) -> str:
        return f"address {self.address}"


class SMC100Line(ControllerLine):
    """One line of controllers; replies are matched by address and command letters."""

    def __init__(self, config: Config, clock: Clock, transcript: Transcript | None) -> None:
        super().__init__(config, clock, transcript, line_framer, baudrate=config.baudrate, xonxoff=True, reply_s=0.5)

    def send(self, address: int, command: str) -> None:
        """Write a command that answers nothing; takes no lock."""
        self.link.write(f"{address}{command}\r\n".encode("ascii"))

    def ask(self, address: int, command: str, value: re.Pattern[str], reply_s: float | None = None) -> str:
        """Ask a question and return the value behind address and letters; once more if the reply is bad.

        Raises ReplyTimeout, ReplyError.
        """
        start = f"{address}{command[:2]}"

        def value_of(frame: bytes) -> str | None:
            reply = frame.decode("ascii", "replace")
            text = reply.removeprefix(start).strip()
            return text if reply.startswith(start) and value.fullmatch(text) else None

        question = f"{address}{command}\r\n".encode("ascii")
        request = f"SMC100 {self.link.port} address {address}, {command}"
        # A caller that sets a time repeats the question itself.
        tries = 2 if reply_s is None else 1
        advice = "Check power, cable, baud rate, address"
        return ask(
            self.link, question, value_of, reply_s or self.reply_s, request=request, what_to_check=advice, tries=tries
        )


_STATE = re.compile(r"[0-9A-Fa-f]{6}")
_LETTER = re.compile(r"[@A-Z]")
_TEXT = re.compile(r".*")


class SMC100Axis(MotionAxis):
    """The stage of one controller."""

    def __init__(self, name: str, config: Config, line: SMC100Line, lines: LineRegistry) -> None:
        super().__init__(name, config, lines.clock)
        self.config: Config = config
        self._line, self._lines = line, lines
        version = self._ask("VE", _TEXT)
        stage = self._optional("ID?")
        if config.stage_id is not None and not stage.startswith(config.stage_id):
            raise WrongDevice(
                f"axis {name}, stage {config.stage_id} on {config.port} address {config.address}",
                f"its stage identifier is {stage!r}",
                "Correct stage_id, port or address in the rig file",
            )
        if "AGP" in version.upper():
            # Its piezo has neither command (EPICS motorNewport).
            if config.speed_deg_s is None:
                raise WrongDevice(
                    f"axis {name}, speed", f"a {version} does not tell it", "State speed_deg_s in the rig file"
                )
            self.speed_deg_s, self.acceleration_deg_s2 = config.speed_deg_s, 10 * config.speed_deg_s
        else:
            self.speed_deg_s, self.acceleration_deg_s2 = self._constant("VA?"), self._constant("AC?")
        if min(self.speed_deg_s, self.acceleration_deg_s2) <= 0:
            raise ReplyError(f"axis {name}, speed", "speed or acceleration is zero", "Set VA and AC of the controller")
        self._device_min_deg = self._constant("SL?")
        self._device_max_deg = self._constant("SR?")
        model, _, firmware = version.rpartition(" ")
        self._model_is_known = any(name_part in version.upper() for name_part in _KNOWN)
        self._identify(
            model=f"{model or version} stage {stage or 'not told'}",
            serial_number="not told by the protocol",
            firmware=firmware,
            address=str(config.address),
        )

    def _ask(self, command: str, value: re.Pattern[str], reply_s: float | None = None) -> str:
        return self._line.ask(self.config.address, command, value, reply_s)

    def _optional(self, command: str) -> str:
        try:
            return self._ask(command, _TEXT)
        except ReplyTimeout:
            # A command that a model does not know answers nothing and leaves an error behind.
            self._take_error()
            return ""

    def _number(self, command: str) -> float:
        return float(self._ask(command, _NUMBER))

    def _constant(self, command: str) -> float:
        return agreed(lambda: self._number(command))

    def _take_error(self) -> str:
        return self._ask("TE", _LETTER)

    def _state(self) -> tuple[int, int]:
        """Return fault word and state; a state that does not exist is a garbled reply."""
        for _ in range(2):
            text = self._ask("TS", _STATE)
            if int(text[4:], 16) in STATES:
                return int(text[:4], 16), int(text[4:], 16)
        raise ReplyError(f"axis {self.name}, state", f"unknown state {text}", "Check the cable; reset the controller")

    def _command(self, command: str) -> None:
        """Send a command that answers nothing and look for the error that it may have left."""
        with self._line.link.lock:
            self._take_error()
            self._line.send(self.config.address, command)
            letter = self._take_error()
        if letter == "@":
            return
        request = f"axis {self.name}, {command}"
        if letter == "H":
            raise NotHomedError(request, f"error H: {ERRORS['H']}", "Home the axis (acquire home)")
        raise CommandRejected(
            request, f"error {letter}: {ERRORS.get(letter, 'unknown')}", "Look at the state of the controller"
        )

    def _do_read_counts(self) -> float:
        return self._number("TP")

    def _do_is_homed(self) -> bool:
        return self._state()[1] in (*READY, MOVING, *DISABLE, *JOGGING)

    def _do_is_moving(self) -> bool:
        return self._state()[1] in (*HOMING, MOVING, *JOGGING)

    def _do_start_move(self, counts: float) -> None:
        self._command(f"PA{counts:.6f}")

    def _do_start_home(self) -> None:
        """Send OR; a controller that is homed already must restart first (RS), as its manual wants it."""
        if self._do_is_homed():
            self._restart()
        self._command("OR")

    def _restart(self) -> None:
        self._line.send(self.config.address, "RS")
        give_up_s = self.clock.now_s() + RESTART_S
        while self.clock.now_s() < give_up_s:
            try:
                if int(self._ask("TS", _STATE, 0.3)[4:], 16) in NOT_REFERENCED:
                    return
            except DeviceError:
                # Silent while it restarts.
                continue
        raise ReplyTimeout(
            f"axis {self.name}, restart before homing", f"not back after {RESTART_S} s", "Switch it off and on again"
        )

    def _do_stop(self) -> None:
        self._line.send(self.config.address, "ST")

    def _fault_words(self) -> list[str]:
        word = self._state()[0]
        return [FAULTS.get(index, f"bit {index}") for index in range(16) if word & (1 << (15 - index))]

    def _do_check_fault(self) -> None:
        # An end of run is a place, not a defect.
        faults = [fault for fault in self._fault_words() if "end of run" not in fault]
        if faults:
            raise CommandRejected(f"axis {self.name}, state", f"fault {', '.join(faults)}", "Remove the cause, reset")

    def _do_warnings(self) -> list[str]:
        state = self._state()[1]
        words = self._fault_words()
        if state in DISABLE:
            words.append("motor disabled (DISABLE state)")
        if not self._model_is_known:
            words.append(f"model {self._identity.model} is not known here, treated as SMC100")
        return words


def open(name: str, config: Config, lines: LineRegistry) -> SMC100Axis:
    """Open one axis; reads its identity, limits and speed and moves nothing."""
    with lines.taken(config.port, SMC100Line, partial(SMC100Line, config, lines.clock)) as line:
        return SMC100Axis(name, config, line, lines)
