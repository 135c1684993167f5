"""Thorlabs LCC25 with a liquid crystal: echo, answer, prompt; two voltages, a mode, an output that can be off."""

import re

from drivers.axes.lcc25 import HIGHEST_V, Config
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

PROMPT = b"> "
# Lowest and highest value of each setting, and the digits of its answer.
SETTINGS = {
    "volt1": (0.0, HIGHEST_V, 3),
    "volt2": (0.0, HIGHEST_V, 3),
    "min": (0.0, HIGHEST_V, 3),
    "max": (0.0, HIGHEST_V, 3),
    "increment": (0.0, HIGHEST_V, 3),
    "freq": (5.0, 150.0, 1),
    "dwell": (0.0, 1e5, 0),
    "mode": (0.0, 2.0, 0),
    "enable": (0.0, 1.0, 0),
    "extern": (0.0, 1.0, 0),
    "remote": (0.0, 1.0, 0),
}
_SETTING = re.compile(r"(\w+)=(\d+(?:\.\d*)?)")


class LCC25Emulator(Emulator):
    """A controller whose output is off when it is switched on; `true_deg(0)` is the voltage that the crystal feels.

    Attributes
    ----------
    values : of all settings, by keyword.
    """

    foreign = b"freq?\r60.0\r" + PROMPT
    pieces = (b"volt1=", b"mode=", b"enable=", b"\r")

    def __init__(self, axis: EmulatedAxis, clock: FastClock, faults: FaultSchedule | None = None) -> None:
        super().__init__([axis], clock, faults)
        self.values = {name: low for name, (low, _, _) in SETTINGS.items()} | {"volt1": 5.0, "mode": 1.0}
        self._lines = LineCollector(b"\r")

    def _do_receive(self, data: bytes) -> None:
        for line in self._lines.lines(data):
            self._apply_faults()
            command = line.strip()
            answer = self._answer(command.lower())
            self._reply(f"{command}\r".encode() + (f"{answer}\r" if answer else "").encode() + PROMPT)

    def _answer(self, command: str) -> str:
        if command == "*idn?":
            return "THORLABS LCC25 VERSION 1.05"
        if command.endswith("?") and command[:-1] in self.values:
            return f"{self.values[command[:-1]]:.{SETTINGS[command[:-1]][2]}f}"
        setting = _SETTING.fullmatch(command)
        if setting is None or setting[1] not in SETTINGS:
            return "Command error CMD_NOT_DEFINED"
        low, high, digits = SETTINGS[setting[1]]
        if not low <= float(setting[2]) <= high:
            return "Command error CMD_ARG_INVALID"
        self.values[setting[1]] = round(float(setting[2]), digits)
        volts = self.values[f"volt{max(1, int(self.values['mode']))}"] * self.values["enable"]
        if volts != self.axes[0].position_deg():
            self.axes[0].move_to(volts)
        return ""


def make(options: ServeOptions) -> LCC25Emulator:
    """One controller with its output off."""
    return LCC25Emulator(options.axis(0.0, HIGHEST_V, 0.0), options.clock, options.faults)


def axis_configs(emulator: LCC25Emulator, port: str) -> list[Config]:
    """Rig entry for the retarder."""
    return [Config(port=port, settle_s=0.02)]


SERVES = {"lcc25": make}
