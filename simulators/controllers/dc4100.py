"""Thorlabs DC4100: four LEDs that are on or off, with a brightness, and a box that refuses what it cannot do.

The wire is that of `drivers/sources/dc4100.py`, whose docstring names the sources. Unverified on a real box: error
numbers and texts, and that a refused setting leaves everything as it was.
"""

from collections.abc import Sequence

from drivers.sources.dc4100 import Config
from simulators.clock import FastClock
from simulators.serial.emulator import Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

#: Half the width of the filter that stands on the bench for each wavelength.
FILTER_NM = 15.0
_UNKNOWN, _RANGE, _NO_LED, _HOT = (1, "unknown command"), (2, "out of range"), (3, "no LED"), (4, "over temperature")


class DC4100Emulator(Emulator):
    """The LED driver box.

    Parameters
    ----------
    wavelengths_nm : LED at each of the four channels; None where none is plugged in.

    Attributes
    ----------
    too_hot : set by `overheat`; no LED can be on then.
    """

    foreign = b"M00223344\r\n"

    def __init__(
        self,
        clock: FastClock,
        faults: FaultSchedule | None = None,
        wavelengths_nm: Sequence[float | None] = (451.0, 524.0, 662.0, 947.0),
        model: str = "DC4100",
    ) -> None:
        super().__init__([], clock, faults)
        self.wavelengths_nm = list(wavelengths_nm)
        self.too_hot = False
        self._model = model
        self._on = [False] * 4
        self._percent = [100.0] * 4
        self._milliampere = [0.0] * 4
        self._mode = 0
        self._error = (0, "no error")
        self._lines = LineCollector(b"\n")

    def light(self) -> dict[float, float]:
        """Relative light now, 0 to 1, by wavelength in nm; wavelengths that are off are left out."""
        with self._lock:
            levels = self._percent if self._mode == 1 else [current / 10.0 for current in self._milliampere]
            return {
                nm: levels[channel] / 100.0
                for channel, nm in enumerate(self.wavelengths_nm)
                if nm is not None and self._on[channel]
            }

    def light_at(self, wavelength_nm: float) -> float:
        """Light of the LEDs near a wavelength; a filter keeps that of the others from the sample."""
        return sum(level for nm, level in self.light().items() if abs(nm - wavelength_nm) <= FILTER_NM)

    def overheat(self, too_hot: bool = True) -> None:
        """Let the box get too hot, which shuts off all LEDs, or cool down."""
        with self._lock:
            self.too_hot = too_hot
            if too_hot:
                self._on = [False] * 4

    def _do_receive(self, data: bytes) -> None:
        for line in self._lines.lines(data):
            if words := line.lower().split():
                self._apply_faults()
                answer = self._answer(words)
                if answer is not None:
                    self._reply(answer.encode() + b"\r\n")

    def _answer(self, words: list[str]) -> str | None:
        name, arguments = words[0], words[1:]
        if name.endswith("?"):
            return self._query(name[:-1], arguments)
        try:
            numbers = [float(word) for word in arguments]
        except ValueError:
            numbers = []
        self._set(name, numbers)
        return None

    def _query(self, name: str, arguments: list[str]) -> str:
        status = 8 * self.too_hot + sum(1 << (5 + 2 * i) for i, nm in enumerate(self.wavelengths_nm) if nm is None)
        if name == "e":
            error, self._error = self._error, (0, "no error")
            return f"ERROR {error[0]}:{error[1]}"
        box_values = {
            "n": self._model,
            "s": "M00223344",
            "v": "1.4.0",
            "h": "Thorlabs",
            "m": str(self._mode),
            "sm": "0",
            "r": str(status),
        }
        if name in box_values and not arguments:
            return box_values[name]
        channel = self._channel(arguments[0] if len(arguments) == 1 else "")
        if channel is not None and (nm := self.wavelengths_nm[channel]) is not None:
            led_values = {
                "wl": f"{nm:.1f}",
                "o": str(int(self._on[channel])),
                "bp": f"{self._percent[channel]:.1f}",
                "cc": f"{self._milliampere[channel]:.0f}",
                "l": "1000",
                "ml": "1000",
                "hs": f"HS{channel}",
            }
            if name in led_values:
                return led_values[name]
        self._error = _UNKNOWN if channel is None else _NO_LED
        return ""

    def _set(self, name: str, numbers: list[float]) -> None:
        if name == "m" and len(numbers) == 1 and numbers[0] in (0, 1, 2):
            # Light of one mode has nothing to do with that of another.
            self._on = [False] * 4
            self._mode = int(numbers[0])
            return
        if name == "sm" and numbers in ([0], [1]):
            return
        if name not in ("o", "bp", "cc") or len(numbers) != 2 or numbers[0] not in (-1, 0, 1, 2, 3):
            self._error = _UNKNOWN
            return
        channels = range(4) if numbers[0] == -1 else [int(numbers[0])]
        highest = {"o": 1, "bp": 100, "cc": 1000}[name]
        for channel in channels:
            if self.wavelengths_nm[channel] is None:
                self._error = self._error if numbers[0] == -1 else _NO_LED
            elif not 0 <= numbers[1] <= highest or (name == "o" and numbers[1] not in (0, 1)):
                self._error = _RANGE
            elif name == "bp":
                self._percent[channel] = numbers[1]
            elif name == "cc":
                self._milliampere[channel] = numbers[1]
            elif numbers[1] and self.too_hot:
                self._error = _HOT
            else:
                self._on[channel] = bool(numbers[1])

    def _channel(self, word: str) -> int | None:
        return int(word) if word in ("0", "1", "2", "3") else None


def make(options: ServeOptions) -> DC4100Emulator:
    """One box with four LEDs, all off."""
    return DC4100Emulator(options.clock, options.faults, model=options.model or "DC4100")


def source_configs(emulator: DC4100Emulator, port: str) -> list[Config]:
    """Rig entry for the box, each LED at full brightness."""
    return [Config(port=port, percent={nm: 100.0 for nm in emulator.wavelengths_nm if nm is not None})]


SERVES = {"dc4100": make}
