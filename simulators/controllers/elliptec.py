"""Thorlabs Elliptec rotation modules on one line: fixed-length packets, one reply at the end of a move."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers.axes.elliptec import Config
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

PULSES_PER_TURN = 0x23000
# A gap of this length inside a packet discards it.
GAP_S = 2.0
# Hex digits behind the two letters of each command.
DATA_DIGITS = {
    "in": 0, "gs": 0, "gp": 0, "gj": 0, "go": 0, "gv": 0, "i1": 0, "i2": 0, "st": 0, "ms": 0, "us": 0,
    "fw": 0, "bw": 0, "ho": 1, "ca": 1, "sv": 2, "ma": 8, "mr": 8, "sj": 8, "so": 8,
}  # fmt: skip


class ElliptecError(Exception):
    """The module refuses the command; the message is the status code that it answers."""


@dataclass
class ElliptecModule:
    """One module.

    Attributes
    ----------
    address : one hex digit.
    serial_number : eight digits.
    model : 14 or 18.
    """

    address: str
    axis: EmulatedAxis
    serial_number: str
    model: int = 14
    jog_counts: int = 0x800
    offset_counts: int = 0
    velocity_percent: int = 100
    status: int = 0
    reports_end: bool = False
    jogging: bool = False

    def __post_init__(self) -> None:
        self._full_speed_deg_s = self.axis.speed_deg_s

    @property
    def per_deg(self) -> float:
        """Pulses per degree."""
        return PULSES_PER_TURN / 360

    def position(self) -> str:
        """Letters and digits that tell the position."""
        return f"PO{round(self.axis.position_deg() * self.per_deg) - self.offset_counts & 0xFFFFFFFF:08X}"

    def run(self, letters: str, data: str) -> str | None:
        """Do one command; return the reply, or None if it comes when the move ends. Raises ElliptecError."""
        if letters == "gs":
            status, self.status = (9 if self.axis.is_moving() else self.status), 0
            return f"GS{status:02X}"
        if self.axis.is_moving() and not (letters in ("st", "ms") and self.jogging):
            raise ElliptecError("09")
        handlers: dict[str, Callable[[str], str | None]] = {
            "in": lambda _: f"IN{self.model:02X}{self.serial_number}20201501{360:04X}{PULSES_PER_TURN:08X}",
            "gp": lambda _: self.position(),
            "gj": lambda _: f"GJ{self.jog_counts:08X}",
            "go": lambda _: f"HO{self.offset_counts & 0xFFFFFFFF:08X}",
            "gv": lambda _: f"GV{self.velocity_percent:02X}",
            "i1": lambda _: "I1" + "11" + "03A4" + "FFFF" + "FFFF" + "00B5" + "008E",
            "i2": lambda _: "I2" + "11" + "03A4" + "FFFF" + "FFFF" + "00B5" + "008E",
            "us": lambda _: "GS00",
            "st": self._stop,
            "ms": self._stop,
            "fw": lambda _: self._jog(1),
            "bw": lambda _: self._jog(-1),
            "ho": self._home,
            "ma": lambda digits: self._go(_signed(digits) + self.offset_counts),
            "mr": lambda digits: self._go(round(self.axis.position_deg() * self.per_deg) + _signed(digits)),
            "sj": self._set_jog,
            "so": self._set_offset,
            "sv": self._set_velocity,
        }
        if letters not in handlers:
            raise ElliptecError("03")
        return handlers[letters](data)

    def _stop(self, _: str) -> str:
        self.axis.stop()
        self.jogging = self.reports_end = False
        return "GS00"

    def _go(self, counts: int) -> None:
        target_deg = counts / self.per_deg
        if not self.axis.within(target_deg):
            raise ElliptecError("0C")
        self.axis.move_to(target_deg)
        self.reports_end = True

    def _jog(self, sign: int) -> str | None:
        if self.jog_counts:
            self._go(round(self.axis.position_deg() * self.per_deg) + sign * self.jog_counts)
            return None
        self.axis.run(sign * self.axis.speed_deg_s)
        self.jogging = True
        return "GS00"

    def _home(self, _: str) -> None:
        self.axis.home()
        self.reports_end = True

    def _set_jog(self, digits: str) -> str:
        self.jog_counts = int(digits, 16)
        return "GS00"

    def _set_offset(self, digits: str) -> str:
        self.offset_counts = _signed(digits)
        return "GS00"

    def _set_velocity(self, digits: str) -> str:
        percent = int(digits, 16)
        if not 1 <= percent <= 100:
            raise ElliptecError("04")
        self.velocity_percent = percent
        self.axis.speed_deg_s = self._full_speed_deg_s * percent / 100
        return "GS00"


def _signed(digits: str) -> int:
    value = int(digits, 16)
    return value - (1 << 32) if value >= 1 << 31 else value


class ElliptecEmulator(Emulator):
    """Modules on one line; `true_deg(i)` belongs to the i-th module."""

    pieces = (b"0ma", b"1mr0000", b"0ho0", b"0gp", b"0gs", b"1in", b"0sj", b"0fw", b"0st", b"\r\n")
    tells_limits = False

    def __init__(
        self, modules: Sequence[ElliptecModule], clock: FastClock, faults: FaultSchedule | None = None
    ) -> None:
        super().__init__([module.axis for module in modules], clock, faults)
        self.modules = list(modules)
        self._buffer = ""
        self._last_byte_s = 0.0

    def _do_receive(self, data: bytes) -> None:
        now_s = self.clock.base.now_s()
        if now_s - self._last_byte_s > GAP_S:
            self._buffer = ""
        self._last_byte_s = now_s
        for character in data.decode("latin-1"):
            # CR resets the receiver, so a trailing CR LF of the host does no harm.
            self._buffer = "" if character in "\r\n" else self._buffer + character
            self._take_packet()

    def _take_packet(self) -> None:
        buffer = self._buffer
        if buffer and buffer[0] not in "0123456789ABCDEFabcdef":
            self._buffer = buffer[1:]
        elif len(buffer) >= 2 and not buffer[1].islower():
            # A stray digit, as some hosts leave behind "ho0".
            self._buffer = buffer[1:]
            self._take_packet()
        elif len(buffer) >= 3:
            letters = buffer[1:3]
            digits = DATA_DIGITS.get(letters, 0)
            data = buffer[3:]
            if data and data[-1] not in "0123456789ABCDEFabcdef":
                self._buffer = ""
                self._command(buffer[0].upper(), "??", "")
            elif len(data) == digits:
                self._buffer = ""
                self._command(buffer[0].upper(), letters, data)

    def _command(self, address: str, letters: str, data: str) -> None:
        self._apply_faults()
        for module in self.modules:
            if module.address != address:
                continue
            try:
                if letters == "ca" and not module.axis.is_moving():
                    module.address = data.upper()
                    answer: str | None = "GS00"
                else:
                    answer = module.run(letters, data)
            except ElliptecError as refusal:
                answer = f"GS{refusal}"
            if answer is not None:
                self._reply(f"{module.address}{answer}\r\n".encode("ascii"))

    def _do_make_foreign(self, reply: bytes) -> bytes:
        text = reply.decode("latin-1")
        return f"{(int(text[0], 16) + 5) % 16:X}{text[1:]}".encode("latin-1")

    def _do_advance(self) -> None:
        for module in self.modules:
            if module.reports_end and not module.axis.is_moving():
                module.reports_end = False
                self._reply(f"{module.address}{module.position()}\r\n".encode("ascii"))

    def _do_next_event_s(self) -> float | None:
        ends = [module.axis.end_s() for module in self.modules if module.reports_end]
        return min(ends) if ends else None


def make(options: ServeOptions) -> ElliptecEmulator:
    """Two rotation modules at addresses 0 and 1."""
    low, high = options.limits_deg or (None, None)
    model = (options.model or "ELL14").upper()
    if not re.fullmatch(r"ELL\d{1,2}", model):
        raise ValueError(f"model {options.model!r} is not ELL14, ELL18 or the like")
    modules = [
        ElliptecModule(
            f"{index:X}", options.axis(low, high, 17.0 * (index + 1)), f"{11400502 + index:08d}", int(model[3:])
        )
        for index in range(options.axes or 2)
    ]
    return ElliptecEmulator(modules, options.clock, options.faults)


def axis_configs(emulator: ElliptecEmulator, port: str) -> list[Config]:
    """Rig entries for every module on the line."""
    return [
        Config(port=port, address=module.address, serial_number=module.serial_number) for module in emulator.modules
    ]


SERVES = {"elliptec": make}
