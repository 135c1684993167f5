"""PI controllers with the General Command Set 2 (C-863, C-867, C-884, ...) and rotation stages.

Facts: PI's own public PIPython (names, single-byte commands, form of the answers, error codes) and the GCS adapter of
Micro-Manager, written at PI. A line ends with LF; an answer is ``1=12.5000``. Without an address in front, one
controller answers on a line: a daisy chain is not supported. The axis's unit must be degrees, which is not asked.
Unverified on hardware: everything; that `FRF` wants the servo on, and that limits of a stage without any are huge.
"""

import re
from functools import partial
from typing import Literal

from pydantic import Field

from drivers.axis_types import stage_limit
from drivers.clock import Clock
from drivers.errors import CommandRejected, NotHomedError, ReplyError, WrongDevice
from drivers.motion import AxisConfig, MotionAxis
from drivers.serial_link import LineRegistry, Transcript, agreed, line_framer
from drivers.text_line import TextLine

ERRORS = {
    1: "parameter syntax error",
    2: "unknown command",
    5: "not referenced, or servo off",
    7: "position out of limits",
    10: "stopped by command",
    15: "invalid axis",
    -1024: "motion error: the position error was too large and the servo was switched off",
}
NOT_REFERENCED, STOPPED = 5, 10
MOVING = "\x05"
_HEX = re.compile(r"[0-9A-Fa-f]{1,8}")
_CODE = re.compile(r"-?\d{1,5}")
_IDENTITY = re.compile(r".*[A-Za-z]{3}.*")


class Config(AxisConfig):
    """An axis of a PI controller in a rig file."""

    kind: Literal["gcs2"] = "gcs2"
    axis: int = Field(default=1, ge=1, le=16, description="axis identifier, as SAI? lists it")
    serial_number: str | None = Field(default=None, description="serial number; another device at this port is refused")
    baudrate: int = Field(default=115_200, description="bits a second, as the controller is set")

    def place(self) -> str:
        return f"axis {self.axis}"


class GCS2Line(TextLine):
    """The port of one controller, shared by its axes."""

    controller, end = "GCS2", "\n"

    def __init__(self, config: Config, clock: Clock, transcript: Transcript | None) -> None:
        super().__init__(config, clock, transcript, line_framer, baudrate=config.baudrate, reply_s=1.0)


def read_identity(text: str) -> tuple[str, str, str, str]:
    """Maker, model, serial number and firmware of an answer to ``*IDN?``; empty where it does not tell them.

    Most controllers separate the four by commas; an E-861 answers
    ``(c)2013 Physik Instrumente(PI) Karlsruhe, E-861 Version 7.2.0``.
    """
    parts = [part.strip() for part in text.split(",")]
    if len(parts) >= 4:
        return parts[0], parts[1], parts[2], ", ".join(parts[3:])
    model = re.search(r"\b[A-Z]-\d{3}[\w.]*", text)
    firmware = re.search(r"version\s+(\S+)", text, re.IGNORECASE)
    return text.strip(), model[0] if model else "", "", firmware[1] if firmware else ""


class GCS2Axis(MotionAxis):
    """One axis of a controller."""

    def __init__(self, name: str, config: Config, line: GCS2Line, lines: LineRegistry) -> None:
        super().__init__(name, config, lines.clock)
        self.config: Config = config
        self._line, self._lines = line, lines
        self._answer = re.compile(rf"{config.axis}=([+-]?\d+\.?\d*(?:[eE][+-]?\d+)?)")
        maker, model, serial_number, firmware = read_identity(line.ask("*IDN?", _IDENTITY))
        label = f"axis {name} on {config.port} axis {config.axis}"
        if "PHYSIK INSTRUMENTE" not in maker.upper():
            raise WrongDevice(label, f"{maker} {model} answers", "Correct `port` in the rig file")
        if config.serial_number is not None and not serial_number:
            raise WrongDevice(
                label, f"{model or maker} tells no serial number", "Take serial_number out of the rig file"
            )
        if config.serial_number not in (None, serial_number):
            raise WrongDevice(label, f"{model} has serial number {serial_number}", "Correct it in the rig file")
        self.speed_deg_s, self.acceleration_deg_s2 = self._constant("VEL?"), self._constant("ACC?")
        if min(self.speed_deg_s, self.acceleration_deg_s2) <= 0:
            raise ReplyError(f"{label}, speed", f"{self.speed_deg_s}, {self.acceleration_deg_s2}", "Set VEL and ACC")
        self._device_min_deg, self._device_max_deg = self._limit("TMN?"), self._limit("TMX?")
        self._identify(model=model, serial_number=serial_number, firmware=firmware, address=str(config.axis))

    def _number(self, query: str) -> float:
        return float(self._line.ask(f"{query} {self.config.axis}", self._answer).partition("=")[2])

    def _constant(self, query: str) -> float:
        return agreed(lambda: self._number(query))

    def _limit(self, query: str) -> float | None:
        return stage_limit(self._constant(query))

    def _take_error(self) -> int:
        """Read the last error, which clears it."""
        return int(self._line.ask("ERR?", _CODE))

    def _command(self, command: str) -> None:
        """Send a command that answers nothing and look for the error that it may have left."""
        with self._line.link.lock:
            self._take_error()
            self._line.send(command)
            code = self._take_error()
        if code in (0, STOPPED):
            return
        request, words = f"axis {self.name}, {command}", f"error {code}: {ERRORS.get(code, 'see the manual')}"
        if code == NOT_REFERENCED:
            raise NotHomedError(request, words, "Home the axis (acquire home)")
        raise CommandRejected(request, words, "Look at the state of the controller")

    def _servo_on(self) -> None:
        if not self._number("SVO?"):
            self._command(f"SVO {self.config.axis} 1")

    def _do_read_counts(self) -> float:
        return self._number("POS?")

    def _do_is_homed(self) -> bool:
        # One garbled digit must not make a reference.
        return self._number("FRF?") == 1 and self._number("FRF?") == 1

    def _do_is_moving(self) -> bool:
        # A hexadecimal number with a bit for each axis.
        answers = [int(self._line.ask(MOVING, _HEX), 16) for _ in range(2)]
        return any(answer >> (self.config.axis - 1) & 1 for answer in answers)

    def _do_start_move(self, counts: float) -> None:
        self._servo_on()
        self._command(f"MOV {self.config.axis} {counts:.6f}")

    def _do_start_home(self) -> None:
        self._servo_on()
        self._command(f"FRF {self.config.axis}")

    def _do_stop(self) -> None:
        # HLT stops this axis alone; the controller notes it as error 10.
        self._line.send(f"HLT {self.config.axis}")

    def _do_check_fault(self) -> None:
        code = self._take_error()
        if code not in (0, STOPPED):
            raise CommandRejected(
                f"axis {self.name}, state", f"error {code}: {ERRORS.get(code, 'see the manual')}", "Remove the cause"
            )

    def _do_warnings(self) -> list[str]:
        return [] if self._number("SVO?") else ["servo off"]


def open(name: str, config: Config, lines: LineRegistry) -> GCS2Axis:
    """Open one axis; reads its identity, limits and speed and moves nothing."""
    with lines.taken(config.port, GCS2Line, partial(GCS2Line, config, lines.clock)) as line:
        return GCS2Axis(name, config, line, lines)
