"""Newport Oriel Cornerstone 260 behind a lamp, over RS-232: an echo, an answer, a grating drive, a shutter."""

import re
from collections.abc import Callable

from drivers.sources.cornerstone import Config
from simulators.clock import FastClock
from simulators.serial.emulator import Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

RANGE_NM = (0.0, 1400.0)
HALF_BAND_NM = 5.0
NOT_UNDERSTOOD, BAD_PARAMETER, NOT_ALLOWED = 1, 2, 3


class CornerstoneEmulator(Emulator):
    """A monochromator whose shutter is closed when it is switched on.

    Parameters
    ----------
    echo : repeats each statement, as over RS-232; over USB it does not.

    Attributes
    ----------
    wavelength_nm, shutter : where the gratings stand, and C or O.
    """

    foreign = b"UNITS?\r\nNM\r\n"
    pieces = (b"GOWAVE ", b"SHUTTER ", b"WAVE?\n", b"ERROR?\n", b"\n")

    def __init__(self, clock: FastClock, faults: FaultSchedule | None = None, echo: bool = True) -> None:
        super().__init__([], clock, faults)
        self.wavelength_nm, self.shutter = 500.0, "C"
        self._echo, self._error, self._status = echo, 0, 0
        self._numbers = {"GRAT": 1, "FILTER": 1, "OUTPORT": 1, "SLIT1MICRONS": 100, "SLIT2MICRONS": 100}
        self._lines = LineCollector(b"\n")

    def light_at(self, wavelength_nm: float) -> float:
        """1 inside the band around its wavelength while the shutter is open."""
        with self._lock:
            return float(self.shutter == "O" and abs(self.wavelength_nm - wavelength_nm) <= HALF_BAND_NM)

    def _do_receive(self, data: bytes) -> None:
        for line in self._lines.lines(data):
            text = line.strip()
            if not text:
                continue
            self._apply_faults()
            answer = self._answer(text.upper())
            lines = [text.upper()] * self._echo + [answer] * (answer is not None)
            self._reply("".join(f"{part}\r\n" for part in lines).encode())

    def _answer(self, text: str) -> str | None:
        queries: dict[str, Callable[[], object]] = {
            "INFO?": lambda: "Oriel Cornerstone 260, 74125, SN1234, V5.02",
            "WAVE?": lambda: f"{self.wavelength_nm:.3f}",
            "SHUTTER?": lambda: self.shutter,
            "ERROR?": self._take_error,
            "STB?": self._take_status,
            "GRAT?": lambda: f"{self._numbers['GRAT']},1200,VIS",
        }
        if text in queries:
            return str(queries[text]())
        if text.endswith("?") and text[:-1] in self._numbers:
            return str(self._numbers[text[:-1]])
        word, _, parameter = text.partition(" ")
        parameter = parameter.strip()
        if word == "GOWAVE" and re.fullmatch(r"\d+(\.\d+)?", parameter):
            if RANGE_NM[0] <= float(parameter) <= RANGE_NM[1]:
                self.wavelength_nm = float(parameter)
            else:
                self._refuse(NOT_ALLOWED)
        elif word == "SHUTTER" and parameter in ("C", "O"):
            if not self.faults.active.keys() & {"stuck", "jammed"}:
                self.shutter = parameter
        elif word in self._numbers and re.fullmatch(r"\d{1,5}", parameter):
            self._numbers[word] = int(parameter)
        elif word != "ABORT":
            self._refuse(BAD_PARAMETER if word in ("GOWAVE", "SHUTTER", *self._numbers) else NOT_UNDERSTOOD)
        return None

    def _refuse(self, code: int) -> None:
        self._error, self._status = code, 32

    def _take_error(self) -> int:
        code, self._error = self._error, 0
        return code

    def _take_status(self) -> str:
        status, self._status = self._status, 0
        return f"{status:02d}"


def make(options: ServeOptions) -> CornerstoneEmulator:
    """One monochromator on RS-232, dark."""
    return CornerstoneEmulator(options.clock, options.faults)


def make_on_usb(options: ServeOptions) -> CornerstoneEmulator:
    """One that repeats no statement."""
    return CornerstoneEmulator(options.clock, options.faults, echo=False)


def source_configs(emulator: CornerstoneEmulator, port: str) -> list[Config]:
    """Rig entry for the monochromator."""
    return [Config(port=port, range_nm=(350.0, 1100.0), move_s=1.0)]


SERVES = {"cornerstone": make, "cornerstone-usb": make_on_usb}
