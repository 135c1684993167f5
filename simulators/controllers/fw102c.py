"""Thorlabs FW102C filter wheel: echo, answer, prompt; a move is answered when the wheel stands."""

from drivers.sources.fw102c import Config
from simulators.clock import FastClock
from simulators.serial.emulator import Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

PROMPT = b"> "
# Filters by position in nm, as RGB950's bands; the last position holds an opaque disc.
FILTERS_NM = {1: 451.0, 2: 524.0, 3: 662.0, 4: 947.0}
OPAQUE = 6
_HALF_BAND_NM = 20.0


class FW102CEmulator(Emulator):
    """A wheel of six positions that stands at the opaque one when it is switched on.

    Parameters
    ----------
    step_s : simulated time from one position to the next.
    """

    foreign = b"closed?\r1\r" + PROMPT

    def __init__(self, clock: FastClock, faults: FaultSchedule | None = None, step_s: float = 0.5) -> None:
        super().__init__([], clock, faults)
        self.step_s = step_s
        self.blocked = False
        self._position = OPAQUE
        self._arrives_s = -1e9
        # Reply to the move under way, and what came in meanwhile: the wheel answers nothing while it turns.
        self._due: bytes | None = None
        self._lines, self._waiting = LineCollector(b"\r"), list[str]()

    def light_at(self, wavelength_nm: float) -> float:
        """1 behind the filter of a wavelength, 0 behind another one and while the wheel turns."""
        with self._lock:
            if self.clock.now_s() < self._arrives_s:
                return 0.0
            nm = FILTERS_NM.get(self._position)
            return float(nm is not None and abs(nm - wavelength_nm) < _HALF_BAND_NM)

    def _do_receive(self, data: bytes) -> None:
        self._waiting += [line.strip("\n") for line in self._lines.lines(data)]
        self._work()

    def _work(self) -> None:
        while self._due is None and self._waiting:
            text = self._waiting.pop(0)
            self._apply_faults()
            if text.startswith("pos=") and text[4:].isdigit() and 1 <= int(text[4:]) <= 6:
                self._turn(int(text[4:]))
                self._due = f"{text}\r".encode("latin-1") + PROMPT
            else:
                answer = self._answer(text)
                self._reply((f"{text}\r" + (f"{answer}\r" if answer else "")).encode("latin-1") + PROMPT)

    def _turn(self, position: int) -> None:
        steps = abs(position - self._position)
        self._arrives_s = self.clock.now_s() + min(steps, 6 - steps) * self.step_s
        if not self.blocked:
            self._position = position

    def _answer(self, text: str) -> str:
        match text:
            case "*idn?":
                return "THORLABS FW102C/FW212C Filter Wheel version 1.07"
            case "pos?":
                return str(self._position)
            case "pcount?":
                return "6"
            case "speed?" | "sensors?" | "trig?" | "baud?":
                return "1"
            case "speed=0" | "speed=1" | "sensors=0" | "sensors=1" | "trig=0" | "trig=1" | "save":
                return ""
        return "Command error CMD_NOT_DEFINED"

    def _do_advance(self) -> None:
        if self._due is not None and self.clock.now_s() >= self._arrives_s:
            due, self._due = self._due, None
            self._reply(due)
            self._work()

    def _do_next_event_s(self) -> float | None:
        return None if self._due is None else self._arrives_s


def make(options: ServeOptions) -> FW102CEmulator:
    """One wheel at its opaque position."""
    return FW102CEmulator(options.clock, options.faults)


def source_configs(emulator: FW102CEmulator, port: str) -> list[Config]:
    """Rig entry for the box."""
    return [Config(port=port, positions={nm: k for k, nm in FILTERS_NM.items()}, dark_position=OPAQUE)]


SERVES = {"fw102c": make}
