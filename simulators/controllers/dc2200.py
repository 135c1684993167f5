"""Thorlabs DC2200 with two LEDs: SCPI in lines, an error memory, LEDs off at power-up and in current mode."""

import re

from drivers.sources.dc2200 import Config
from simulators.clock import FastClock
from simulators.serial.emulator import Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

#: Half the width of the filter that stands on the bench for each wavelength.
FILTER_NM = 15.0
_UNDEFINED, _RANGE, _SETTINGS = -113, -222, -221
_LED = re.compile(r"(OUTP|SOUR)(?:UT|CE)?([12])?:(.*)")


class DC2200Emulator(Emulator):
    """The LED driver box with an LED at each terminal, wavelengths in nm."""

    foreign = b"THORLABS,ITC4020,E12345678,1.4.0/2.0.3/1.6.0\n"

    def __init__(
        self,
        clock: FastClock,
        faults: FaultSchedule | None = None,
        wavelengths_nm: tuple[float, float] = (662.0, 451.0),
    ) -> None:
        super().__init__([], clock, faults)
        self.wavelengths_nm = wavelengths_nm
        self._on = [False, False]
        self._mode = ["CC", "CC"]
        self._percent = [100.0, 100.0]
        self._error = 0
        self._lines = LineCollector(b"\n")

    def light_at(self, wavelength_nm: float) -> float:
        """Light of the LEDs near a wavelength; a filter keeps that of the other from the sample."""
        with self._lock:
            return sum(
                percent / 100.0
                for nm, on, percent in zip(self.wavelengths_nm, self._on, self._percent, strict=True)
                if on and abs(nm - wavelength_nm) <= FILTER_NM
            )

    def _do_receive(self, data: bytes) -> None:
        for line in self._lines.lines(data):
            if text := line.strip():
                self._apply_faults()
                answer = self._run(text.upper())
                if answer is not None:
                    self._reply(f"{answer}\n".encode())

    def _run(self, text: str) -> str | None:
        if text == "*IDN?":
            return "THORLABS,DC2200,M00960538,1.5.0"
        if text in ("SYSTEM:ERROR?", "SYST:ERR?"):
            code, self._error = self._error, 0
            return f'{code},"{"No error" if code == 0 else "Error"}"'
        match = _LED.fullmatch(text)
        answer = None if match is None else self._led(match[1], int(match[2] or 1) - 1, match[3])
        if answer is None:
            self._error = _UNDEFINED
        return answer or None

    def _led(self, part: str, led: int, tail: str) -> str | None:
        """Answer to a question, an empty text for a setting, None for an unknown command."""
        words = tail.split()
        setting_of = {"STATE": "STAT", "MODE": "MODE", "CBRIGHTNESS:BRIGHTNESS": "LEVEL"}
        # AMPLitude may be left out, or be cut to its capitals, as SCPI has it.
        header = re.sub(r":AMPL(ITUDE)?$", "", words[0].rstrip("?"))
        name = setting_of.get(re.sub(r":BRIG$", ":BRIGHTNESS", header).replace("CBR:", "CBRIGHTNESS:"))
        if name is None or (name == "STAT") != (part == "OUTP"):
            return None
        if words[0].endswith("?"):
            values = {"STAT": str(int(self._on[led])), "MODE": self._mode[led], "LEVEL": f"{self._percent[led]:.1f}"}
            return values[name]
        value = words[1] if len(words) == 2 else ""
        if name == "STAT" and value in ("ON", "OFF", "1", "0"):
            self._on[led] = value in ("ON", "1")
        elif name == "MODE" and value in ("CC", "CB", "PWM", "TTL"):
            self._mode[led] = value
        elif name == "LEVEL" and self._mode[led] != "CB":
            self._error = _SETTINGS
        elif name == "LEVEL" and re.fullmatch(r"\d+(\.\d*)?", value) and float(value) <= 100:
            self._percent[led] = float(value)
        else:
            self._error = _RANGE
        return ""


def make(options: ServeOptions) -> DC2200Emulator:
    """One box with LEDs of 662 and 451 nm, both off."""
    return DC2200Emulator(options.clock, options.faults)


def source_configs(emulator: DC2200Emulator, port: str) -> list[Config]:
    """Rig entry for the box."""
    return [Config(port=port, terminals=dict(zip(emulator.wavelengths_nm, (1, 2), strict=True)))]


SERVES = {"dc2200": make}
