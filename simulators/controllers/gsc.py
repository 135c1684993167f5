"""OptoSigma GSC-01 and GSC-02: a move is set, then driven; the first acknowledges each command, the second does not.

Commands, ranges and answers are those of the two manuals that `drivers.axes.gsc` names. `?:SW` is a SHOT-302GS's.
"""

import math
import re
from functools import partial

from drivers.axes.gsc import HOMING_PPS, Config
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

PULSES_PER_DEG = 400.0
MOST_PULSES = 16_777_215
_SET = re.compile(r"([MA]):([12W])(?=[+-])((?:[+-]P\d{1,8})+)")
_JOG = re.compile(r"J:([12W])([+-]+)")
_SPEED = re.compile(r"D:([12W])((?:S\d{1,5}F\d{1,5}R\d{1,4}){1,2})")
# Lowest and highest speed, pulses a second; a GSC-02 has two ranges.
SPEEDS = {"1": (1, 200), "2": (50, 20_000)}
SPEEDS_OF_A_GSC_01 = (100, 20_000)
LONGEST_RAMP_MS = 1000


class GSCEmulator(Emulator):
    """A controller with one or two stages."""

    # The answer to another question: the state of an input.
    foreign = b"I:4\r\n"
    pieces = (b"Q:\r\n", b"\r\nQ:\r\n", b"M:1+P", b"A:1-P", b"G:", b"H:1", b"L:", b"!:\r\n", b"?:V", b"J:1+", b"\r\n")
    tells_limits = False

    def __init__(
        self, axes: list[EmulatedAxis], clock: FastClock, faults: FaultSchedule | None = None, *, acknowledges: bool
    ) -> None:
        super().__init__(axes, clock, faults)
        self.acknowledges = acknowledges
        self._lines = LineCollector()
        self._is_accepted = True
        self._free = False
        # Of the next drive: for each axis a target in degrees, or a direction of jogging.
        self._next: dict[int, float | str] = {}

    def pulses(self, index: int) -> int:
        """Coordinate of an axis."""
        return round(self.axes[index].position_deg() * PULSES_PER_DEG)

    def _do_receive(self, data: bytes) -> None:
        for line in self._lines.lines(data):
            if text := line.strip():
                self._apply_faults()
                self._line(text)

    def _line(self, text: str) -> None:
        answers = {"Q:": self._status(), "!:": self._busy(), "?:V": "V1.10"}
        if self.acknowledges:
            text = text.upper()
            answers |= {"?:-": "001", "?:SW": "2"}
        if text in answers:
            self._reply(f"{answers[text]}\r\n".encode())
            return
        self._is_accepted = self._run(text)
        if self.acknowledges:
            self._reply(b"OK\r\n" if self._is_accepted else b"NG\r\n")

    def _busy(self) -> str:
        return "B" if any(axis.is_moving() for axis in self.axes) else "R"

    def _status(self) -> str:
        # Signs stand at the left of ten places.
        pulses = [self.pulses(index) for index in range(len(self.axes))]
        places = [f"{'-' if count < 0 else ' '}{abs(count):9d}" for count in pulses]
        is_at_end = [not axis.is_moving() and axis.position_deg() in (axis.min_deg, axis.max_deg) for axis in self.axes]
        at_limit = "W" if is_at_end == [True, True] else "L" if is_at_end[0] else "M" if any(is_at_end) else "K"
        return ",".join((*places, "K" if self._is_accepted else "X", at_limit, self._busy()))

    def _chosen(self, selection: str) -> list[int]:
        indices = list(range(len(self.axes))) if selection == "W" else [int(selection) - 1]
        return indices if max(indices) < len(self.axes) else []

    def _run(self, text: str) -> bool:
        """Do a command; False for one that is wrong or not allowed now."""
        stop = re.fullmatch(r"L:([12WE])", text)
        if stop is not None:
            return self._stop("W" if stop[1] == "E" else stop[1])
        if self._busy() == "B" or (self._free and text[0] in "HMAJG"):
            return False
        if (move := _SET.fullmatch(text)) is not None:
            return self._set(move[1] == "A", self._chosen(move[2]), re.findall(r"([+-])P(\d+)", move[3]))
        if (jog := _JOG.fullmatch(text)) is not None:
            indices = self._chosen(jog[1])
            self._next = dict(zip(indices, jog[2], strict=False))
            return bool(indices) and len(indices) == len(jog[2])
        if text == ("G:" if self.acknowledges else "G"):
            return self._drive()
        if (speed := _SPEED.fullmatch(text)) is not None:
            return self._set_speeds(speed[1], re.findall(r"S(\d+)F(\d+)R(\d+)", speed[2]))
        # A GSC-02 needs the direction; a GSC-01 knows it.
        home = re.fullmatch(r"H:([12W])([+-]{0,2})", text)
        if home is not None and bool(home[2]) != self.acknowledges:
            for index in self._chosen(home[1]):
                self.axes[index].home(HOMING_PPS / PULSES_PER_DEG)
            self._next = {}
            return bool(self._chosen(home[1]))
        if (zero := re.fullmatch(r"R:([12W])", text)) is not None:
            for index in self._chosen(zero[1]):
                self.axes[index].call_position(0.0)
            return bool(self._chosen(zero[1]))
        return self._hold(text)

    def _hold(self, text: str) -> bool:
        hold = re.fullmatch(r"C:([12W])([01]{1,2})", text)
        if hold is None or not self._chosen(hold[1]):
            return False
        # The answer of a free motor of a GSC-02 is not in its manual.
        self._free = self.acknowledges and hold[2] == "0"
        return True

    def _set_speeds(self, selection: str, speeds: list[tuple[str, str, str]]) -> bool:
        low, high = SPEEDS_OF_A_GSC_01 if self.acknowledges else SPEEDS.get(selection, (1, 0))
        numbers = [(int(start), int(top), int(ramp)) for start, top, ramp in speeds]
        if len(numbers) != len(self.axes) or not all(
            low <= start <= top <= high and ramp <= LONGEST_RAMP_MS for start, top, ramp in numbers
        ):
            return False
        for axis, (_, top, ramp) in zip(self.axes, numbers, strict=True):
            # A GSC-01 counts in hundreds.
            axis.speed_deg_s = (top // 100 * 100 if self.acknowledges else top) / PULSES_PER_DEG
            axis.acceleration_deg_s2 = axis.speed_deg_s * 1000 / ramp if ramp else math.inf
        return True

    def _set(self, absolute: bool, chosen: list[int], pulses: list[tuple[str, str]]) -> bool:
        counts = [int(sign + digits) for sign, digits in pulses]
        starts = [0 if absolute else self.pulses(index) for index in chosen]
        # A GSC-02 has no absolute moves.
        if len(chosen) != len(counts) or not chosen or (absolute and not self.acknowledges):
            return False
        ends = [abs(start + count) for start, count in zip(starts, counts, strict=True)]
        # The manual of the GSC-01 limits the coordinate, that of the GSC-02 the way.
        if max(ends if self.acknowledges else map(abs, counts)) > MOST_PULSES - (not self.acknowledges):
            return False
        self._next = {
            index: (start + count) / PULSES_PER_DEG for index, start, count in zip(chosen, starts, counts, strict=True)
        }
        return True

    def _drive(self) -> bool:
        nexts, self._next = self._next, {}
        for index, target in nexts.items():
            axis = self.axes[index]
            if isinstance(target, str):
                axis.run(axis.speed_deg_s / 10 * (1 if target == "+" else -1))
            else:
                low = -math.inf if axis.min_deg is None else axis.min_deg
                axis.move_to(min(max(target, low), math.inf if axis.max_deg is None else axis.max_deg))
        return bool(nexts)

    def _stop(self, selection: str) -> bool:
        indices = self._chosen(selection)
        for index in indices:
            # While it homes, a GSC-02 obeys only commands for all axes.
            if selection == "W" or self.acknowledges or not self.axes[index].homing:
                self.axes[index].stop()
        self._next = {}
        return bool(indices)


def _make(axes: int, options: ServeOptions) -> GSCEmulator:
    if options.axes not in (None, 1):
        raise ValueError("of a SHOT controller one axis can be in a rig")
    low, high = options.limits_deg or (None, None)
    stages = [options.axis(low, high, 14.0 * (k + 1)) for k in range(axes)]
    return GSCEmulator(stages, options.clock, options.faults, acknowledges=axes == 1)


def axis_configs(emulator: GSCEmulator, port: str) -> list[Config]:
    """Rig entry for the first axis."""
    axis = emulator.axes[0]
    return [
        Config(
            port=port,
            speed_pps=axis.speed_deg_s * PULSES_PER_DEG,
            acceleration_s=axis.speed_deg_s / axis.acceleration_deg_s2,
            home_direction=None if emulator.acknowledges else "-",
        )
    ]


SERVES = {"gsc-01": partial(_make, 1), "gsc-02": partial(_make, 2)}
