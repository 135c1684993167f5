"""OWIS PS90 with rotation stages: a letter of state for each axis, targets that are set and then gone to."""

import re
from collections.abc import Callable

from drivers.axes.owis import Config
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

COUNTS_PER_DEG = 1000.0
_ORDER = re.compile(r"([A-Z]+)([1-9])(?:=(-?\d{1,10}))?")
_QUESTION = re.compile(r"\?([A-Z]+)([1-9])?")


class OWISEmulator(Emulator):
    """One unit; `true_deg(i)` belongs to the i-th axis."""

    # The answer to another question.
    foreign = b"00 NO ERROR\r"
    pieces = (
        *(b"?ASTAT\r", b"\r?ASTAT\r", b"?CNT1\r", b"PSET1=", b"PGO1\r", b"REF1=4\r", b"STOP1\r"),
        *(b"INIT1\r", b"MOFF1\r", b"RELAT1\r", b"ABSOL1\r", b"\r"),
    )
    tells_limits = False

    def __init__(self, axes: list[EmulatedAxis], clock: FastClock, faults: FaultSchedule | None = None) -> None:
        super().__init__(axes, clock, faults)
        self._lines = LineCollector()
        self._ready = [False] * len(axes)
        self._relative = [False] * len(axes)
        self._targets = [0] * len(axes)
        self._memory: dict[str, int] = {}

    def _do_receive(self, data: bytes) -> None:
        for line in self._lines.lines(data):
            if text := line.strip():
                self._apply_faults()
                if not text.startswith("?"):
                    self._obey(text)
                elif (answer := self._answer(text)) is not None:
                    self._reply(f"{answer}\r".encode())

    def _counts(self, index: int) -> int:
        return round(self.axes[index].position_deg() * COUNTS_PER_DEG)

    def _state(self, index: int) -> str:
        axis = self.axes[index]
        if axis.is_moving():
            return "P" if axis.homing else "T"
        return "R" if self._ready[index] else "O"

    def _answer(self, text: str) -> str | None:
        question = _QUESTION.fullmatch(text)
        if question is None:
            return None
        if question[2] is None:
            states = "".join(self._state(index) for index in range(len(self.axes)))
            answers = {"ASTAT": states, "VERSION": "PS90-V6.2-240219", "MSG": "00 NO ERROR", "ERR": "0", "COMEND": "0"}
            return answers.get(question[1])
        index = int(question[2]) - 1
        if index >= len(self.axes):
            return None
        questions: dict[str, Callable[[], int]] = {
            "CNT": lambda: self._counts(index),
            "PSET": lambda: self._targets[index],
            "REFST": lambda: self.axes[index].homed,
            "ESTAT": lambda: 0,
            "MOTYPE": lambda: 2,
        }
        if question[1] in questions:
            return str(int(questions[question[1]]()))
        return str(self._memory[text[1:]]) if text[1:] in self._memory else None

    def _obey(self, text: str) -> None:
        """Do a command; none is answered, and a wrong one is ignored."""
        order = _ORDER.fullmatch(text)
        if order is None or int(order[2]) > len(self.axes):
            return
        index, value = int(order[2]) - 1, order[3]
        axis, moves = self.axes[index], self.axes[index].is_moving()
        match order[1], value is not None:
            case "STOP", False:
                axis.stop()
            case (("INIT" | "MON"), False):
                self._ready[index] = True
            case "MOFF", False if not moves:
                self._ready[index] = False
            case (("ABSOL" | "RELAT"), False):
                self._relative[index] = order[1] == "RELAT"
            case "PSET", True:
                self._targets[index] = int(value)
            case "PGO", False if self._ready[index] and not moves:
                self._go(index)
            case "REF", True if self._ready[index] and not moves and 0 <= int(value) <= 7:
                axis.home()
            case "CNT", True if not moves:
                axis.call_position(int(value) / COUNTS_PER_DEG)
            case _, True:
                self._memory[order[1] + order[2]] = int(value)

    def _go(self, index: int) -> None:
        counts = self._targets[index] + (self._counts(index) if self._relative[index] else 0)
        if self.axes[index].within(counts / COUNTS_PER_DEG):
            self.axes[index].move_to(counts / COUNTS_PER_DEG)


def make(options: ServeOptions) -> OWISEmulator:
    """One axis, or as many as wanted up to nine, switched off and not homed."""
    if not 1 <= (options.axes or 1) <= 9:
        raise ValueError("an OWIS unit has one to nine axes")
    low, high = options.limits_deg or (None, None)
    axes = [options.axis(low, high, 21.0 + k) for k in range(options.axes or 1)]
    return OWISEmulator(axes, options.clock, options.faults)


def axis_configs(emulator: OWISEmulator, port: str) -> list[Config]:
    """Rig entries for every axis."""
    speeds = [(axis.speed_deg_s, axis.acceleration_deg_s2) for axis in emulator.axes]
    return [
        Config(
            port=port, axis=k + 1, counts_per_deg=COUNTS_PER_DEG, speed_deg_s=speed, acceleration_deg_s2=acceleration
        )
        for k, (speed, acceleration) in enumerate(speeds)
    ]


SERVES = {"owis": make}
