"""A PI controller with the General Command Set 2 and rotation stages: servo off and not referenced at power-up."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from drivers.axes.gcs2 import Config
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

MOVING, READY, STOP_ALL = 0x05, 0x07, 0x18
SYNTAX, UNKNOWN, NOT_REFERENCED, OUT_OF_LIMITS, STOPPED, NO_AXIS = 1, 2, 5, 7, 10, 15
SERIAL_NUMBER = "0115012345"
HELP = [
    "#5 request motion status",
    "#7 request controller ready status",
    "#24 stop all axes",
    *("*IDN?", "ACC?", "ERR?", "FRF", "FRF?", "HLP?", "HLT", "MOV", "MOV?", "MVR", "ONT?", "POS?", "SAI?", "STP"),
    *("SVO", "SVO?", "TMN?", "TMX?", "VEL", "VEL?"),
]
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


class Gcs2Error(Exception):
    """The command fails; `code` is what ERR? tells next."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass
class Stage:
    """One axis of the controller."""

    axis: EmulatedAxis
    servo: bool = False
    target_deg: float = 0.0


class GCS2Emulator(Emulator):
    """A controller with axes 1, 2, ...; `true_deg(i)` belongs to axis i + 1."""

    # The answer for another axis; a number without an axis is all that other questions get.
    foreign = b"9=77.0000\n"
    pieces = (b"MOV 1 ", b"FRF", b"SVO 1 1\n", b"POS?\n", b"HLT 2", b"VEL 1 ", b"\x05", b"\x18", b"ERR?\n", b"\n")

    def __init__(self, stages: Sequence[Stage], clock: FastClock, faults: FaultSchedule | None = None) -> None:
        super().__init__([stage.axis for stage in stages], clock, faults)
        self.stages = list(stages)
        self.model = "C-884.4DC"
        self.error = 0
        self._lines = LineCollector(b"\n")

    def _do_receive(self, data: bytes) -> None:
        for byte in data:
            # Single bytes are heard at once, also in the middle of a line.
            if byte in (MOVING, READY, STOP_ALL):
                self._single_byte_command(byte)
            else:
                for line in self._lines.lines(bytes([byte])):
                    self._command(line.strip())

    def _single_byte_command(self, byte: int) -> None:
        self._apply_faults()
        if byte == MOVING:
            bits = sum(stage.axis.is_moving() << index for index, stage in enumerate(self.stages))
            self._reply(f"{bits:X}\n".encode())
        elif byte == READY:
            self._reply(b"\xb1\n")
        else:
            for stage in self.stages:
                stage.axis.stop()
            self.error = STOPPED

    def _command(self, text: str) -> None:
        if not text:
            return
        self._apply_faults()
        words = text.split()
        try:
            answer = self._run(words[0].upper(), words[1:])
        except Gcs2Error as failure:
            self.error = failure.code
            return
        if answer is not None:
            self._reply(answer.encode("latin-1"))

    def _run(self, command: str, words: list[str]) -> str | None:
        general: dict[str, Callable[[], str]] = {
            "*IDN?": lambda: f"(c)2015 Physik Instrumente (PI) GmbH & Co. KG, {self.model}, {SERIAL_NUMBER}, 1.2.1.0\n",
            "ERR?": lambda: f"{self._take_error()}\n",
            "HLP?": lambda: _lines(["The following commands are valid:", *HELP, "end of help"]),
            "SAI?": lambda: _lines(str(index + 1) for index in range(len(self.stages))),
        }
        if command in general:
            return general[command]()
        questions: dict[str, Callable[[Stage], object]] = {
            "POS?": lambda stage: f"{stage.axis.position_deg():.6f}",
            "MOV?": lambda stage: f"{stage.target_deg:.6f}",
            "ONT?": lambda stage: int(not stage.axis.is_moving()),
            "FRF?": lambda stage: int(stage.axis.homed),
            "SVO?": lambda stage: int(stage.servo),
            "TMN?": lambda stage: -1e7 if stage.axis.min_deg is None else f"{stage.axis.min_deg:.4f}",
            "TMX?": lambda stage: 1e7 if stage.axis.max_deg is None else f"{stage.axis.max_deg:.4f}",
            "VEL?": lambda stage: f"{stage.axis.speed_deg_s:.4f}",
            "ACC?": lambda stage: f"{stage.axis.acceleration_deg_s2:.4f}",
        }
        if command in questions:
            axes = words or [str(index + 1) for index in range(len(self.stages))]
            return _lines(f"{axis}={questions[command](self._stage(axis))}" for axis in axes)
        self._act(command, words)
        return None

    def _take_error(self) -> int:
        error, self.error = self.error, 0
        return error

    def _stage(self, axis: str) -> Stage:
        if not axis.isdigit() or not 1 <= int(axis) <= len(self.stages):
            raise Gcs2Error(NO_AXIS)
        return self.stages[int(axis) - 1]

    def _act(self, command: str, words: list[str]) -> None:
        if command in ("HLT", "FRF", "STP"):
            for axis in words or [str(index + 1) for index in range(len(self.stages))]:
                stage = self._stage(axis)
                if command == "FRF":
                    self._reference(stage)
                else:
                    stage.axis.stop()
            if command != "FRF":
                self.error = STOPPED
            return
        settings: dict[str, Callable[[Stage, float], None]] = {
            "MOV": self._move,
            "MVR": lambda stage, by: self._move(stage, stage.axis.position_deg() + by),
            "SVO": self._servo,
            "VEL": self._velocity,
        }
        if command not in settings:
            raise Gcs2Error(UNKNOWN)
        if not words or len(words) % 2:
            raise Gcs2Error(SYNTAX)
        for axis, value in zip(words[::2], words[1::2], strict=True):
            if not _NUMBER.fullmatch(value):
                raise Gcs2Error(SYNTAX)
            settings[command](self._stage(axis), float(value))

    def _move(self, stage: Stage, target_deg: float) -> None:
        if not stage.axis.homed or not stage.servo:
            raise Gcs2Error(NOT_REFERENCED)
        if not stage.axis.within(target_deg):
            raise Gcs2Error(OUT_OF_LIMITS)
        stage.target_deg = target_deg
        stage.axis.move_to(target_deg)

    def _reference(self, stage: Stage) -> None:
        if not stage.servo:
            raise Gcs2Error(NOT_REFERENCED)
        stage.target_deg = 0.0
        stage.axis.home()

    def _servo(self, stage: Stage, on: float) -> None:
        stage.servo = bool(on)
        if not stage.servo:
            stage.axis.stop()

    def _velocity(self, stage: Stage, value: float) -> None:
        if value <= 0:
            raise Gcs2Error(OUT_OF_LIMITS)
        stage.axis.speed_deg_s = value


def _lines(lines: Iterable[str]) -> str:
    # All lines but the last end with a blank.
    return " \n".join(lines) + "\n"


def make(options: ServeOptions) -> GCS2Emulator:
    """Two rotation stages without limits, servos off, not referenced."""
    low, high = options.limits_deg or (None, None)
    stages = [Stage(options.axis(low, high, 20.0 * (index + 1))) for index in range(options.axes or 2)]
    emulator = GCS2Emulator(stages, options.clock, options.faults)
    emulator.model = options.model or emulator.model
    return emulator


def axis_configs(emulator: GCS2Emulator, port: str) -> list[Config]:
    """Rig entries for every axis."""
    return [Config(port=port, axis=index + 1) for index in range(len(emulator.stages))]


SERVES = {"gcs2": make}
