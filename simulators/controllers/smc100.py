"""Newport SMC100 and CONEX controllers on one line: the state machine, its refusals and its error memory."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from drivers.axes.smc100 import Config
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

ERROR_TEXTS = {
    "@": "No error",
    "A": "Unknown message code or floating point controller address",
    "C": "Parameter missing or out of range",
    "D": "Command not allowed",
    "G": "Displacement out of limits",
    "H": "Command not allowed in NOT REFERENCED state",
    "I": "Command not allowed in CONFIGURATION state",
    "J": "Command not allowed in DISABLE state",
    "K": "Command not allowed in READY state",
    "L": "Command not allowed in HOMING state",
    "M": "Command not allowed in MOVING state",
}
_COMMAND = re.compile(r"(\d*)([A-Za-z]{2})(.*)")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


class Smc100Error(Exception):
    """The controller refuses the command; the message is the letter for its error memory."""


@dataclass
class SMC100Controller:
    """One controller with its stage.

    Attributes
    ----------
    version, stage : what ``VE`` and ``ID?`` answer.
    restart_s : simulated time that a reset takes.
    """

    address: int
    axis: EmulatedAxis
    version: str = "SMC100CC 2.0.1"
    stage: str = "URS150CC"
    restart_s: float = 0.3
    error: str = "@"
    disabled: bool = False
    configuring: bool = False
    # Settings that are only kept: jerk time, homing type, speed and time-out, backlash, hysteresis, encoder, error.
    settings: dict[str, str] = field(
        default_factory=lambda: {
            "JR": "0.04", "HT": "2", "OH": "20", "OT": "30", "BA": "0", "BH": "0", "SU": "0.001", "FE": "1",
        }
    )  # fmt: skip
    came_by: int = 0x0A
    target_deg: float = 0.0
    silent_until_s: float = 0.0

    def state(self) -> int:
        """State code as ``TS`` shows it."""
        axis = self.axis
        moving = axis.is_moving()
        if moving and axis.homing:
            return 0x1E
        if self.configuring:
            return 0x14
        if not axis.homed:
            return 0x0A if self.came_by >= 0x32 else self.came_by
        if moving:
            return 0x28
        if self.disabled:
            return 0x3C
        return self.came_by if self.came_by >= 0x32 else 0x32

    def run(self, letters: str, value: str) -> str | None:
        """Do one command; return the reply's value, or None where the real one answers nothing.

        Raises Smc100Error with the letter of the error.
        """
        handlers: dict[str, Callable[[str], str | None]] = {
            "VE": lambda _: " " + self.version,
            "ID": self._id,
            "TS": lambda _: f"0000{self.state():02X}",
            "TE": self._take_error,
            "TB": lambda letter: f"{letter or self.error} {ERROR_TEXTS.get(letter or self.error, 'Unknown')}",
            "TP": lambda _: f"{self.axis.position_deg():.5f}",
            "TH": lambda _: f"{self.target_deg:.5f}",
            "SL": lambda text: self._setting(text, "min_deg", -1e6, 0.0),
            "SR": lambda text: self._setting(text, "max_deg", 0.0, 1e6),
            "VA": lambda text: self._setting(text, "speed_deg_s", 1e-6, 1e4),
            "AC": lambda text: self._setting(text, "acceleration_deg_s2", 1e-6, 1e6),
            "PA": self._absolute,
            "PR": self._relative,
            "PT": self._move_time,
            "OR": self._home,
            "ST": self._stop,
            "MM": self._enable,
            "RS": self._reset,
            "PW": self._configure,
        }
        if letters in ("VA", "AC") and "AGP" in self.version:
            raise Smc100Error("D")
        if letters in self.settings:
            return self._keep(letters, value)
        if letters not in handlers:
            raise Smc100Error("A")
        return handlers[letters](value)

    def _id(self, value: str) -> str:
        if value != "?":
            raise Smc100Error("D")
        return self.stage

    def _take_error(self, _: str) -> str:
        error, self.error = self.error, "@"
        return error

    def _setting(self, value: str, name: str, low: float, high: float) -> str | None:
        """Answer a question, or change an attribute of the axis."""
        if value == "?":
            return f"{getattr(self.axis, name):g}"
        new = _number(value)
        if not low <= new <= high:
            raise Smc100Error("C")
        if self.state() in (0x1E, 0x28):
            raise Smc100Error("L" if self.state() == 0x1E else "M")
        setattr(self.axis, name, new)
        return None

    def _keep(self, letters: str, value: str) -> str | None:
        if value == "?":
            return self.settings[letters]
        _number(value)
        self.settings[letters] = value
        return None

    def _configure(self, value: str) -> str | None:
        """Enter (1) or leave (0) CONFIGURATION, from NOT REFERENCED only."""
        if value == "?":
            return str(int(self.configuring))
        if value not in ("0", "1"):
            raise Smc100Error("C")
        if self.state() not in (0x0A, 0x14):
            raise Smc100Error("D")
        self.configuring = value == "1"
        return None

    def _refuse_unless_ready(self) -> None:
        state = self.state()
        refusals = {0x1E: "L", 0x28: "M", 0x3C: "J"}
        if state < 0x1E:
            raise Smc100Error("I" if state == 0x14 else "H")
        if state in refusals:
            raise Smc100Error(refusals[state])

    def _absolute(self, value: str) -> str | None:
        if value == "?":
            return f"{self.target_deg:.5f}"
        target_deg = _number(value)
        self._refuse_unless_ready()
        if not self.axis.within(target_deg):
            raise Smc100Error("G")
        self.target_deg, self.came_by = target_deg, 0x33
        self.axis.move_to(target_deg)
        return None

    def _relative(self, value: str) -> str | None:
        return self._absolute(f"{self.axis.position_deg() + _number(value):.9f}")

    def _move_time(self, value: str) -> str:
        distance = abs(_number(value))
        return f"{distance / self.axis.speed_deg_s + self.axis.speed_deg_s / self.axis.acceleration_deg_s2:g}"

    def _home(self, _: str) -> None:
        state = self.state()
        if state == 0x14:
            raise Smc100Error("I")
        if state >= 0x1E:
            raise Smc100Error({0x1E: "L", 0x28: "M", 0x3C: "J"}.get(state, "K"))
        self.target_deg, self.came_by = 0.0, 0x32
        self.axis.home()

    def _stop(self, _: str) -> None:
        if self.axis.is_moving() and self.axis.homing:
            self.came_by = 0x0B
        self.axis.stop()
        self.target_deg = self.axis.position_deg()

    def _enable(self, value: str) -> str | None:
        if value == "?":
            return str(int(not self.disabled))
        if value not in ("0", "1"):
            raise Smc100Error("C")
        state = self.state()
        if state < 0x1E:
            raise Smc100Error("H")
        if state in (0x1E, 0x28):
            raise Smc100Error("L" if state == 0x1E else "M")
        self.disabled = value == "0"
        self.came_by = 0x34
        return None

    def _reset(self, _: str) -> None:
        self.axis.lose_reference()
        self.disabled, self.configuring, self.error, self.came_by = False, False, "@", 0x0A
        self.silent_until_s = self.axis.clock.now_s() + self.restart_s


def _number(value: str) -> float:
    if not _NUMBER.fullmatch(value):
        raise Smc100Error("C")
    return float(value)


class SMC100Emulator(Emulator):
    """Controllers on one line; `true_deg(i)` belongs to the i-th controller."""

    pieces = (b"\r\n1TS\r\n", b"1PA", b"1OR", b"1TS", b"1RS", b"1MM0", b"1VA", b"1SL-", b"ST", b"1PW1", b"\r\n", b"?")

    def __init__(
        self, controllers: Sequence[SMC100Controller], clock: FastClock, faults: FaultSchedule | None = None
    ) -> None:
        super().__init__([controller.axis for controller in controllers], clock, faults)
        self.controllers = {controller.address: controller for controller in controllers}
        self._lines = LineCollector()

    def _do_receive(self, data: bytes) -> None:
        for line in self._lines.lines(data):
            # Blanks mean nothing anywhere in a command.
            if text := line.replace(" ", ""):
                self._command(text)

    def _command(self, text: str) -> None:
        match = _COMMAND.fullmatch(text)
        if match is None:
            return
        self._apply_faults()
        number, letters, value = match[1], match[2].upper(), match[3]
        if number in ("", "0"):
            # A stop without an address goes to all.
            controllers = list(self.controllers.values()) if letters == "ST" else []
        else:
            controllers = [self.controllers[int(number)]] if int(number) in self.controllers else []
        for controller in controllers:
            if self.clock.now_s() < controller.silent_until_s:
                continue
            try:
                answer = controller.run(letters, value)
            except Smc100Error as refusal:
                controller.error = str(refusal)
                continue
            if answer is not None:
                self._reply(f"{controller.address}{letters}{answer}\r\n".encode("latin-1"))

    def _do_make_foreign(self, reply: bytes) -> bytes:
        text = reply.decode("latin-1")
        match = re.match(r"\d+", text)
        address = int(match[0]) if match else 0
        return f"{address % 31 + 1}{text[len(str(address)) :]}".encode("latin-1")


def make(options: ServeOptions) -> SMC100Emulator:
    """One controller at address 1 that is NOT REFERENCED, with travel from 0 to 180 degrees."""
    controllers = []
    low, high = options.limits_deg or (0.0, 180.0)
    if low is None or high is None:
        raise ValueError("an SMC100 has software limits at both ends; give both")
    for index in range(options.axes or 1):
        controller = SMC100Controller(index + 1, options.axis(low, high, 25.0))
        if options.model is not None:
            controller.version = f"{options.model} 2.0.1"
        controllers.append(controller)
    return SMC100Emulator(controllers, options.clock, options.faults)


def axis_configs(emulator: SMC100Emulator, port: str) -> list[Config]:
    """Rig entries for every controller on the line."""
    entries = []
    for address, controller in emulator.controllers.items():
        speed_deg_s = controller.axis.speed_deg_s if "AGP" in controller.version else None
        entries.append(Config(port=port, address=address, speed_deg_s=speed_deg_s))
    return entries


def make_agp(options: ServeOptions) -> SMC100Emulator:
    """A CONEX-AGP, which knows neither speed nor acceleration."""
    return make(replace(options, model=options.model or "CONEX-AGP"))


SERVES = {"smc100": make, "conex-agp": make_agp}
