"""OptoSigma GSC-01 and GSC-02: a move is set, then driven; the first acknowledges each command, the second does not."""

from __future__ import annotations

import re
from functools import partial

from drivers.axes.gsc import Config
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

PULSES_PER_DEG = 400.0
MOST_PULSES = 16_777_214
_SET = re.compile(r"([MA]):([12W])(?=[+-])((?:[+-]P\d{1,8})+)")
_JOG = re.compile(r"J:([12W])([+-]+)")
_SPEED = re.compile(r"D:[12](?:S(\d{1,6})F(\d{1,6})R(\d{1,4}))+")


class GSCEmulator(Emulator):
    """A controller with one or two stages."""

    pieces = (b"Q:\r\n", b"\r\nQ:\r\n", b"M:1+P", b"A:1-P", b"G:", b"H:1", b"L:", b"!:\r\n", b"?:V", b"J:1+", b"\r\n")
    tells_limits = False

    def __init__(
        self, axes: list[EmulatedAxis], clock: FastClock, faults: FaultSchedule | None = None, *, acknowledges: bool
    ) -> None:
        super().__init__(axes, clock, faults)
        self.acknowledges = acknowledges
        self._lines = LineCollector()
        self._taken = True
        # What the next drive does: for each axis a target in degrees, or a direction of jogging.
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
        divisions = ",".join("2" for _ in self.axes)
        answers = {"Q:": self._status(), "!:": self._busy(), "?:V": "V1.10", "?:-": "3", "?:SW": divisions}
        if text in answers:
            self._reply(f"{answers[text]}\r\n".encode())
            return
        self._taken = self._run(text)
        if self.acknowledges:
            self._reply(b"OK\r\n" if self._taken else b"NG\r\n")

    def _busy(self) -> str:
        return "B" if any(axis.is_moving() for axis in self.axes) else "R"

    def _status(self) -> str:
        # Signs stand at the left of ten places.
        pulses = [self.pulses(index) for index in range(len(self.axes))]
        places = [f"{'-' if count < 0 else ' '}{abs(count):9d}" for count in pulses]
        return ",".join((*places, "K" if self._taken else "X", "K", self._busy()))

    def _chosen(self, which: str) -> list[int]:
        indices = list(range(len(self.axes))) if which == "W" else [int(which) - 1]
        return indices if max(indices) < len(self.axes) else []

    def _run(self, text: str) -> bool:
        """Do a command; False for one that is wrong or not allowed now."""
        stop = re.fullmatch(r"L:([12WE])", text)
        if stop is not None:
            return self._stop("W" if stop[1] == "E" else stop[1])
        if self._busy() == "B":
            return False
        if (move := _SET.fullmatch(text)) is not None:
            return self._set(move[1] == "A", self._chosen(move[2]), re.findall(r"([+-])P(\d+)", move[3]))
        if (jog := _JOG.fullmatch(text)) is not None:
            chosen = self._chosen(jog[1])
            self._next = dict(zip(chosen, jog[2], strict=False))
            return bool(chosen) and len(chosen) == len(jog[2])
        if text in ("G:", "G"):
            return self._drive()
        if (speed := _SPEED.fullmatch(text)) is not None:
            self.axes[0].speed_deg_s = max(int(speed[2]), 1) / PULSES_PER_DEG
            return True
        # A GSC-02 must be told the direction; a GSC-01 knows it.
        home = re.fullmatch(r"H:([12W])([+-]{0,2})", text)
        if home is not None and bool(home[2]) != self.acknowledges:
            for index in self._chosen(home[1]):
                self.axes[index].home()
            self._next = {}
            return bool(self._chosen(home[1]))
        if (zero := re.fullmatch(r"R:([12W])", text)) is not None:
            for index in self._chosen(zero[1]):
                self.axes[index].call_position(0.0)
            return bool(self._chosen(zero[1]))
        return re.fullmatch(r"C:[12W][01]{1,2}", text) is not None

    def _set(self, absolute: bool, chosen: list[int], pulses: list[tuple[str, str]]) -> bool:
        counts = [int(sign + digits) for sign, digits in pulses]
        if len(chosen) != len(counts) or not chosen or max(map(abs, counts)) > MOST_PULSES:
            return False
        starts = [0 if absolute else self.pulses(index) for index in chosen]
        self._next = {
            index: (start + count) / PULSES_PER_DEG for index, start, count in zip(chosen, starts, counts, strict=True)
        }
        return True

    def _drive(self) -> bool:
        nexts, self._next = self._next, {}
        for index, what in nexts.items():
            axis = self.axes[index]
            if isinstance(what, str):
                axis.run(axis.speed_deg_s / 10 * (1 if what == "+" else -1))
            elif axis.within(what):
                axis.move_to(what)
        return bool(nexts)

    def _stop(self, which: str) -> bool:
        chosen = self._chosen(which)
        for index in chosen:
            # While it homes, a GSC-02 obeys what is meant for all axes alone.
            if which == "W" or self.acknowledges or not self.axes[index].homing:
                self.axes[index].stop()
        self._next = {}
        return bool(chosen)

    def _do_make_foreign(self, reply: bytes) -> bytes:
        # The answer to another question: the state of an input that nobody asked for.
        return b"I:4\r\n"


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
