"""ICP DAS I-7060 relay module: DCON protocol, four relays, a host watchdog that opens them."""

from drivers.sources.i7000 import Config
from simulators.clock import FastClock
from simulators.serial.emulator import Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

#: Bit of the module's status that says that the host watchdog has run out.
RUN_OUT = 0x04


class I7060Emulator(Emulator):
    """The module at address 01, all relays open; light passes while relay 0 is closed."""

    foreign = b"!027060\r"

    def __init__(self, clock: FastClock, faults: FaultSchedule | None = None) -> None:
        super().__init__([], clock, faults)
        self._outputs = 0
        self._watchdog_s: float | None = None
        self._status = 0
        self._heard_s = clock.now_s()
        self._lines = LineCollector(b"\r")

    def light_at(self, wavelength_nm: float) -> float:
        """1 or 0: a relay knows no colour."""
        with self._lock:
            self._look()
            return float(self._outputs & 1)

    def _look(self) -> None:
        """Open the relays if no heartbeat came in time; they stay open until the status is cleared."""
        if self._watchdog_s is not None and self.clock.now_s() - self._heard_s > self._watchdog_s:
            self._status, self._outputs, self._watchdog_s = RUN_OUT, 0, None

    def _do_receive(self, data: bytes) -> None:
        for line in self._lines.lines(data):
            command = line.strip("\n")
            self._look()
            if command == "~**":
                self._heard_s = self.clock.now_s()
                continue
            self._apply_faults()
            answer = self._answer(command)
            if answer is not None:
                self._reply(answer.encode() + b"\r")

    def _answer(self, command: str) -> str | None:
        if command[1:3] != "01":
            return None
        match command[0] + command[3:]:
            case "$M":
                return "!017060"
            case "$6":
                return f"!{self._outputs:02X}0000"
            case "~0":
                return f"!01{self._status:02X}"
            case "~1":
                self._status = 0
                return "!01"
        if command[0] == "~" and command[3:5] in ("30", "31") and len(command) == 7:
            self._watchdog_s = int(command[5:], 16) / 10 if command[4] == "1" else None
            self._heard_s = self.clock.now_s()
            return "!01"
        if command[0] == "#" and command[3] == "1" and command[5:] in ("00", "01") and command[4] in "0123":
            return self._switch(int(command[4]), command[5:] == "01")
        return "?01"

    def _switch(self, output: int, on: bool) -> str:
        if self._status & RUN_OUT:
            return "!"
        self._outputs = self._outputs | 1 << output if on else self._outputs & ~(1 << output)
        return ">"


def make(options: ServeOptions) -> I7060Emulator:
    """One module, its relays open."""
    return I7060Emulator(options.clock, options.faults)


def source_configs(emulator: I7060Emulator, port: str) -> list[Config]:
    """Rig entry for the module as a plain switch: the heartbeat is the guard's."""
    return [Config(port=port, watchdog_s=None)]


SERVES = {"i7060": make}
