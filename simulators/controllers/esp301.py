"""Newport ESP301 with axes in degrees: commands in lines, an error memory, motors off at power-up."""

import re
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers.axes.esp301 import Config
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

ERROR_TEXTS = {
    0: "NO ERROR DETECTED",
    6: "COMMAND DOES NOT EXIST",
    7: "PARAMETER OUT OF RANGE",
    9: "AXIS NUMBER OUT OF RANGE",
    37: "AXIS NUMBER MISSING",
    38: "COMMAND PARAMETER MISSING",
}
AXIS_ERROR_TEXTS = {
    1: "PARAMETER OUT OF RANGE",
    6: "POSITIVE SOFTWARE LIMIT DETECTED",
    7: "NEGATIVE SOFTWARE LIMIT DETECTED",
    13: "MOTOR NOT ENABLED",
    20: "HOMING ABORTED",
    30: "COMMAND NOT ALLOWED DURING HOMING",
}
POSITIVE_LIMIT, NEGATIVE_LIMIT, MOTOR_OFF, HOMING_ABORTED, IN_HOMING = 6, 7, 13, 20, 30
LONGEST_LINE = 80
_COMMAND = re.compile(r"(\d*)([A-Z]{2})(\?|[+-]?(?:\d+\.?\d*|\.\d+)(?:E[+-]?\d+)?)?")


class Esp301Error(Exception):
    """The command fails; `code` goes into the error memory."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass
class ESPAxis:
    """One axis of the controller."""

    axis: EmulatedAxis
    stage: str
    motor_on: bool = False
    target_deg: float = 0.0
    unit: int = 7
    offset_deg: float = 0.0

    def position(self) -> float:
        """Position in the controller's unit."""
        return self.axis.position_deg() - self.offset_deg


class ESP301Emulator(Emulator):
    """A controller with up to three axes; `true_deg(i)` belongs to axis i + 1."""

    # Replies carry no address: the only possible fault is the answer to another question.
    foreign = b"ESP301 Version 3.0.1 6/1/99\r\n"
    pieces = (b"1PA", b"1OR1", b"1MO", b"TB?", b"1DH", b"1SL", b";", b"\r", b"AB", b"2TP?")

    def __init__(self, stages: Sequence[ESPAxis], clock: FastClock, faults: FaultSchedule | None = None) -> None:
        super().__init__([stage.axis for stage in stages], clock, faults)
        self.stages = list(stages)
        self.errors: deque[tuple[int, int]] = deque(maxlen=10)
        self._lines = LineCollector()
        self._waiting: list[str] = []
        self._wait_for: ESPAxis | None = None
        self._go_on_s = 0.0

    def _do_receive(self, data: bytes) -> None:
        for line in self._lines.lines(data):
            # Case and blanks mean nothing.
            text = line.replace(" ", "").upper()
            self._waiting += [part for part in text[:LONGEST_LINE].split(";") if part]
        self._work()

    def _work(self) -> None:
        """Run the queued commands up to the next one that waits for a motion."""
        while self._waiting:
            if self._wait_for is not None:
                if self._wait_for.axis.is_moving() or self.clock.now_s() < self._go_on_s:
                    # A stop is obeyed at once, also while the queue waits.
                    urgent = [text for text in self._waiting if text.endswith("ST") or text == "AB"]
                    self._waiting = [text for text in self._waiting if text not in urgent]
                    for text in urgent:
                        self._command(text)
                    return
                self._wait_for = None
            self._command(self._waiting.pop(0))

    def _do_advance(self) -> None:
        self._work()

    def _do_next_event_s(self) -> float | None:
        if not self._waiting or self._wait_for is None:
            return None
        return max(self._wait_for.axis.end_s(), self._go_on_s)

    def _command(self, text: str) -> None:
        self._apply_faults()
        match = _COMMAND.fullmatch(text)
        try:
            if match is None:
                raise Esp301Error(6)
            answer = self._run(match[1], match[2], match[3] or "")
        except Esp301Error as failure:
            self.errors.append((failure.code, round(self.clock.now_s() * 1000)))
            return
        if answer is not None:
            self._reply(f"{answer}\r\n".encode("latin-1"))

    def _run(self, number: str, letters: str, value: str) -> str | None:
        general: dict[str, Callable[[], str | None]] = {
            "VE": lambda: "ESP301 Version 3.0.1 6/1/99",
            "TE": lambda: str(self._take_error()[0]),
            "TB": self._error_text,
            "TS": lambda: "P",
            "AB": self._abort,
            "RS": self._reset,
        }
        if letters in general:
            return general[letters]()
        by_axis: dict[str, Callable[[ESPAxis, int, str], str | None]] = {
            "ID": lambda stage, *_: stage.stage,
            "TP": lambda stage, *_: f"{stage.position():.4f}",
            "TV": lambda stage, *_: f"{stage.axis.velocity_deg_s():.4f}",
            "DP": lambda stage, *_: f"{stage.target_deg:.4f}",
            "MD": lambda stage, *_: str(int(not stage.axis.is_moving())),
            "MO": self._motor_on,
            "MF": self._motor_off,
            "OR": self._home,
            "PA": self._absolute,
            "PR": lambda stage, axis, text: self._absolute(stage, axis, f"{stage.position() + _number(text)}"),
            "ST": lambda stage, *_: self._stop(stage),
            "VA": lambda stage, axis, value: self._speed(stage, axis, value, "speed_deg_s"),
            "AC": lambda stage, axis, value: self._speed(stage, axis, value, "acceleration_deg_s2"),
            "AG": lambda stage, axis, value: self._speed(stage, axis, value, "acceleration_deg_s2"),
            "SL": lambda stage, _, value: self._limit(stage, value, "min_deg", -1e6),
            "SR": lambda stage, _, value: self._limit(stage, value, "max_deg", 1e6),
            "SN": self._unit,
            "DH": self._define_home,
            "WS": self._wait_stop,
        }
        if letters not in by_axis:
            raise Esp301Error(6)
        if not number:
            if letters == "ST":
                for stage in self.stages:
                    self._stop(stage)
                return None
            raise Esp301Error(37)
        axis = int(number)
        if not 1 <= axis <= len(self.stages):
            raise Esp301Error(9)
        return by_axis[letters](self.stages[axis - 1], axis, value)

    def _take_error(self) -> tuple[int, int]:
        return self.errors.popleft() if self.errors else (0, round(self.clock.now_s() * 1000))

    def _error_text(self) -> str:
        code, time_ms = self._take_error()
        text = ERROR_TEXTS.get(code) if code < 100 else AXIS_ERROR_TEXTS.get(code % 100)
        prefix = f"AXIS-{code // 100} " if code >= 100 else ""
        return f"{code}, {time_ms}, {prefix}{text or 'ERROR'}"

    def _abort(self) -> None:
        self._waiting.clear()
        self._wait_for = None
        for stage in self.stages:
            self._stop(stage)

    def _reset(self) -> None:
        self._abort()
        self.errors.clear()
        for stage in self.stages:
            stage.axis.lose_reference()
            stage.motor_on = False

    def _stop(self, stage: ESPAxis) -> None:
        if stage.axis.homing and stage.axis.is_moving():
            number = self.stages.index(stage) + 1
            self.errors.append((number * 100 + HOMING_ABORTED, round(self.clock.now_s() * 1000)))
        stage.axis.stop()
        stage.target_deg = stage.position()

    def _motor_on(self, stage: ESPAxis, _: int, value: str) -> str | None:
        if value == "?":
            return str(int(stage.motor_on))
        stage.motor_on = True
        return None

    def _motor_off(self, stage: ESPAxis, _: int, value: str) -> str | None:
        if value == "?":
            return str(int(stage.motor_on))
        stage.axis.stop()
        stage.motor_on = False
        return None

    def _refuse_unless_free(self, stage: ESPAxis, axis: int) -> None:
        if not stage.motor_on:
            raise Esp301Error(axis * 100 + MOTOR_OFF)
        if stage.axis.is_moving() and stage.axis.homing:
            raise Esp301Error(axis * 100 + IN_HOMING)

    def _home(self, stage: ESPAxis, axis: int, value: str) -> None:
        self._refuse_unless_free(stage, axis)
        if value and _number(value) not in range(7):
            raise Esp301Error(7)
        stage.axis.home()
        stage.target_deg = stage.offset_deg = 0.0

    def _absolute(self, stage: ESPAxis, axis: int, value: str) -> str | None:
        if value == "?":
            return f"{stage.target_deg:.4f}"
        target_deg = _number(value)
        self._refuse_unless_free(stage, axis)
        reported_deg = target_deg + stage.offset_deg
        if not stage.axis.within(reported_deg):
            too_far = stage.axis.max_deg is not None and reported_deg > stage.axis.max_deg
            raise Esp301Error(axis * 100 + (POSITIVE_LIMIT if too_far else NEGATIVE_LIMIT))
        stage.target_deg = target_deg
        stage.axis.move_to(reported_deg)
        return None

    def _speed(self, stage: ESPAxis, axis: int, value: str, name: str) -> str | None:
        if value == "?":
            return f"{getattr(stage.axis, name):g}"
        if _number(value) <= 0:
            raise Esp301Error(axis * 100 + 1)
        setattr(stage.axis, name, _number(value))
        return None

    def _limit(self, stage: ESPAxis, value: str, name: str, without: float) -> str | None:
        if value == "?":
            limit_deg = getattr(stage.axis, name)
            return f"{without if limit_deg is None else limit_deg - stage.offset_deg:g}"
        setattr(stage.axis, name, _number(value) + stage.offset_deg)
        return None

    def _unit(self, stage: ESPAxis, _: int, value: str) -> str | None:
        if value == "?":
            return str(stage.unit)
        if _number(value) not in range(12):
            raise Esp301Error(7)
        stage.unit = int(_number(value))
        return None

    def _define_home(self, stage: ESPAxis, _: int, value: str) -> str | None:
        if value == "?":
            return f"{-stage.offset_deg:.4f}"
        stage.offset_deg = stage.axis.position_deg() - (_number(value) if value else 0.0)
        stage.target_deg = stage.position()
        return None

    def _wait_stop(self, stage: ESPAxis, _: int, value: str) -> None:
        self._wait_for = stage
        extra_s = _number(value) / 1000 if value else 0.0
        self._go_on_s = max(stage.axis.end_s(), self.clock.now_s()) + extra_s


def _number(value: str) -> float:
    if value in ("", "?"):
        raise Esp301Error(38)
    return float(value)


def make(options: ServeOptions) -> ESP301Emulator:
    """Two axes in degrees, motors off, travel from -180 to 180 degrees."""
    low, high = options.limits_deg or (-180.0, 180.0)
    stages = [
        ESPAxis(options.axis(low, high, 15.0 * (index + 1)), f"{options.model or 'URS75CC'}, SN{1263 + index}")
        for index in range(options.axes or 2)
    ]
    return ESP301Emulator(stages, options.clock, options.faults)


def axis_configs(emulator: ESP301Emulator, port: str) -> list[Config]:
    """Rig entries for every axis of the controller."""
    return [Config(port=port, axis=index + 1) for index in range(len(emulator.stages))]


SERVES = {"esp301": make}
