"""Thorlabs SC10 shutter controller: echo, answer, prompt; a toggle for the enable state, an interlock input."""

import re

from drivers.sources.sc10 import Config
from simulators.clock import FastClock
from simulators.serial.emulator import Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

PROMPT = b"> "


class SC10Emulator(Emulator):
    """The shutter box. `interlock_tripped` is the door contact; while it is set the blade is shut.

    Parameters
    ----------
    blade_s : simulated time that the blade takes.
    """

    foreign = b"closed?\r1\r" + PROMPT

    def __init__(self, clock: FastClock, faults: FaultSchedule | None = None, blade_s: float = 0.01) -> None:
        super().__init__([], clock, faults)
        self.blade_s = blade_s
        self.interlock_tripped = False
        self._mode = 1
        self._enabled = False
        self._changed_s = -1e9
        # Where a blade that sticks stays.
        self._stuck: bool | None = None
        # Times in milliseconds, repeats, trigger and speed of the line: kept, and without effect here.
        self._numbers = {"open": 1000, "shut": 1000, "rep": 1, "trig": 0, "baud": 0, "xto": 0}
        self._lines = LineCollector(b"\r")

    def is_open(self) -> bool:
        """True if light passes now."""
        with self._lock:
            return self._blade_open()

    def light_at(self, wavelength_nm: float) -> float:
        """1 or 0: a blade knows no colour."""
        return float(self.is_open())

    def trip(self, tripped: bool) -> None:
        """Open (True) or close the interlock circuit; an open one disables the shutter."""
        with self._lock:
            self.interlock_tripped = tripped
            if tripped and self._enabled:
                self._enabled = False
                self._changed_s = self.clock.now_s()

    def _blade_open(self) -> bool:
        if self._stuck is not None:
            return self._stuck
        arrived = self.clock.now_s() >= self._changed_s + self.blade_s
        return self._enabled if arrived else not self._enabled

    def _stick(self, sticks: bool) -> None:
        if not sticks:
            self._stuck = None
        elif self._stuck is None:
            self._stuck = self._blade_open()

    def _do_receive(self, data: bytes) -> None:
        for line in self._lines.lines(data):
            command = line.strip("\n")
            self._apply_faults()
            self._stick(bool(self.faults.active.keys() & {"stuck", "jammed"}))
            answer = self._answer(command)
            self._reply((f"{command}\r" + (f"{answer}\r" if answer else "")).encode("latin-1") + PROMPT)

    def _answer(self, command: str) -> str:
        match command.lower():
            case "id?":
                return "THORLABS SC10 VERSION 1.07"
            case "ens?":
                return str(int(self._enabled))
            case "closed?":
                blade_open = self._enabled if "jammed" in self.faults.active else self._blade_open()
                return str(int(not blade_open))
            case "interlock?":
                return str(int(self.interlock_tripped))
            case "mode?":
                return str(self._mode)
            case "open?" | "shut?" | "rep?" | "trig?" | "baud?" | "xto?":
                return str(self._numbers[command.lower().rstrip("?")])
            case "ens":
                if not self.interlock_tripped:
                    self._enabled = not self._enabled
                    self._changed_s = self.clock.now_s()
                return ""
            case "mode=1" | "mode=2" | "mode=3" | "mode=4" | "mode=5":
                self._mode = int(command[-1])
                return ""
        setting = re.fullmatch(r"(open|shut|rep|trig|baud|xto)=(\d+)", command.lower())
        if setting is not None:
            self._numbers[setting[1]] = int(setting[2])
            return ""
        return "Command error CMD_NOT_DEFINED"


def make(options: ServeOptions) -> SC10Emulator:
    """One shutter box, shut, its interlock circuit closed."""
    return SC10Emulator(options.clock, options.faults)


def source_configs(emulator: SC10Emulator, port: str) -> list[Config]:
    """Rig entry for the box."""
    return [Config(port=port)]


SERVES = {"sc10": make}
