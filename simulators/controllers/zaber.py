"""Zaber ASCII devices on one daisy chain (firmware 6/7), as far as the public protocol sheet tells.

Unverified on hardware: the words of the rejections, the unit of speed and acceleration.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from drivers.axes.zaber import Config
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.line_collector import LineCollector
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

# Velocity unit per microstep/s, and acceleration unit per microstep/s^2 (unverified).
VELOCITY_UNIT = 1.6384
ACCELERATION_UNIT = 1.6384 / 10_000

_COMMAND = re.compile(
    r"/(?P<numbers>(?:\s*\d+(?=[\s:]|$)){0,3})\s*(?P<words>[^:]*?)\s*(?::(?P<checksum>[0-9A-Fa-f]{2}))?"
)


def checksum(text: str) -> str:
    """Two's complement of the low byte of the sum of all characters, two upper-case hex digits."""
    return f"{-sum(text.encode('latin-1')) & 0xFF:02X}"


class Rejected(Exception):
    """The device refuses the command; the message is the word that it answers."""


@dataclass
class ZaberDevice:
    """One single-axis device of the chain."""

    address: int
    axis: EmulatedAxis
    serial_number: int
    device_id: int = 50081
    microsteps_per_turn: int = 768_000
    settings: dict[str, str] = field(default_factory=dict)
    # Setting `comm.checksum`: 0 leaves the checksum off every reply.
    sums: bool = True
    # Setting `limit.approach.maxspeed` in deg/s; None for that of moves. Homing takes the lesser of the two.
    approach_deg_s: float | None = None
    interrupted: bool = False
    alerts_for: int | None = None
    # Flags that a test raises: FS stalled, WT hot, ...
    extra_flags: list[str] = field(default_factory=list)

    @property
    def per_deg(self) -> float:
        """Microsteps per degree."""
        return self.microsteps_per_turn / 360.0

    def limit(self, end_deg: float | None, sign: int) -> int:
        """A limit in microsteps; a rotary stage without limits reports a huge one."""
        return sign * 1_000_000_000 if end_deg is None else round(end_deg * self.per_deg)

    def flags(self) -> list[str]:
        """Warning flags, the gravest first."""
        return sorted(self.extra_flags) + ["WR"] * (not self.axis.homed) + ["NI"] * self.interrupted

    def position(self) -> int:
        """Position as `get pos` reports it."""
        axis = self.axis
        if not axis.homed and not axis.is_moving() and axis.max_deg is not None and not self.interrupted:
            # Seen on real hardware: without a reference the highest position is shown (labscript-devices#39).
            return self.limit(axis.max_deg, 1)
        return round(axis.position_deg() * self.per_deg)

    def run(self, words: list[str]) -> str:
        """Do one command and return its data field. Raises Rejected with the word of the rejection."""
        command, arguments = (words[0], words[1:]) if words else ("", [])
        handlers: dict[str, Callable[[list[str]], str]] = {
            "": lambda _: "0",
            "get": self._get,
            "set": self._set,
            "move": self._move,
            "home": self._home,
            "stop": self._stop,
            "estop": self._stop,
            "warnings": self._warnings,
            "system": self._system,
            "tools": lambda names: " ".join(names[1:]) or "0",
        }
        if command not in handlers:
            raise Rejected("BADCOMMAND")
        return handlers[command](arguments)

    def _readable(self) -> dict[str, Callable[[], object]]:
        axis = self.axis
        return {
            "pos": self.position,
            "deviceid": lambda: self.device_id,
            "device.id": lambda: self.device_id,
            "system.serial": lambda: self.serial_number,
            "version": lambda: "7.38",
            "version.build": lambda: 15000,
            "system.axiscount": lambda: 1,
            "system.access": lambda: 1,
            "comm.address": lambda: self.address,
            "comm.checksum": lambda: int(self.sums),
            "resolution": lambda: 64,
            "limit.min": lambda: self.limit(axis.min_deg, -1),
            "limit.max": lambda: self.limit(axis.max_deg, 1),
            "limit.home.triggered": lambda: int(axis.homed),
            "limit.cycle.dist": lambda: self.microsteps_per_turn,
            "maxspeed": lambda: round(axis.speed_deg_s * self.per_deg * VELOCITY_UNIT),
            "limit.approach.maxspeed": lambda: round(
                (self.approach_deg_s or axis.speed_deg_s) * self.per_deg * VELOCITY_UNIT
            ),
            "accel": lambda: round(axis.acceleration_deg_s2 * self.per_deg * ACCELERATION_UNIT),
        }

    def _get(self, arguments: list[str]) -> str:
        if len(arguments) != 1:
            raise Rejected("BADDATA")
        readable = self._readable()
        if arguments[0] in readable:
            return str(readable[arguments[0]]())
        if arguments[0] in self.settings:
            return self.settings[arguments[0]]
        raise Rejected("BADCOMMAND")

    def _set(self, arguments: list[str]) -> str:
        if len(arguments) != 2:
            raise Rejected("BADDATA")
        name, value = arguments[0], _integer(arguments[1])
        axis = self.axis
        if name == "maxspeed" and value > 0:
            axis.speed_deg_s = value / VELOCITY_UNIT / self.per_deg
        elif name == "accel" and value > 0:
            axis.acceleration_deg_s2 = value / ACCELERATION_UNIT / self.per_deg
        elif name == "limit.min":
            axis.min_deg = value / self.per_deg
        elif name == "limit.max":
            axis.max_deg = value / self.per_deg
        elif name == "comm.alert" and value in (0, 1):
            self.settings[name] = str(value)
        else:
            raise Rejected("BADDATA" if name in ("maxspeed", "accel") else "BADCOMMAND")
        return "0"

    def _move(self, arguments: list[str]) -> str:
        axis = self.axis
        kind = arguments[0] if arguments else ""
        if kind in ("min", "max") and len(arguments) == 1:
            end = axis.min_deg if kind == "min" else axis.max_deg
            if end is None or not axis.homed:
                raise Rejected("BADDATA")
            self._go(end)
        elif kind in ("abs", "rel", "vel") and len(arguments) == 2:
            value = _integer(arguments[1]) / self.per_deg
            if kind == "vel":
                self.interrupted = False
                axis.run(value / VELOCITY_UNIT) if value else axis.stop()
                return "0"
            if kind == "abs" and not axis.homed:
                raise Rejected("BADDATA")
            self._go(value if kind == "abs" else axis.position_deg() + value)
        else:
            raise Rejected("BADCOMMAND")
        return "0"

    def _go(self, target_deg: float) -> None:
        if self.axis.homed and not self.axis.within(target_deg):
            raise Rejected("BADDATA")
        self.interrupted = False
        self.axis.move_to(target_deg)
        self.alerts_for = 1

    def _home(self, _: list[str]) -> str:
        self.interrupted = False
        self.axis.home(min(self.approach_deg_s or self.axis.speed_deg_s, self.axis.speed_deg_s))
        self.alerts_for = 1
        return "0"

    def _stop(self, _: list[str]) -> str:
        self.interrupted = self.interrupted or self.axis.is_moving()
        self.axis.stop()
        return "0"

    def _warnings(self, arguments: list[str]) -> str:
        flags = self.flags()
        if arguments == ["clear"]:
            self.interrupted = False
        elif arguments:
            raise Rejected("BADCOMMAND")
        return " ".join([f"{len(flags):02d}", *flags])

    def _system(self, arguments: list[str]) -> str:
        if arguments != ["reset"]:
            raise Rejected("BADCOMMAND")
        self.axis.lose_reference()
        return "0"


def _integer(text: str) -> int:
    if not re.fullmatch(r"-?\d{1,15}", text):
        raise Rejected("BADDATA")
    return int(text)


class ZaberEmulator(Emulator):
    """A daisy chain of single-axis devices; `true_deg(i)` belongs to the i-th device.

    Parameters
    ----------
    devices : in chain order.
    """

    pieces = (b"/1 1 move abs ", b"/1 home", b"/0 0 01 get pos:", b"/2 set maxspeed ", b"/1 move vel ", b"stop", b"\n")

    def __init__(self, devices: Sequence[ZaberDevice], clock: FastClock, faults: FaultSchedule | None = None) -> None:
        super().__init__([device.axis for device in devices], clock, faults)
        self.devices = list(devices)
        self._lines = LineCollector()

    def _do_receive(self, data: bytes) -> None:
        for line in self._lines.lines(data):
            # A new command starts at the slash, after any bytes before it.
            start = line.rfind("/")
            if start >= 0:
                self._command(line[start:])

    def _command(self, text: str) -> None:
        match = _COMMAND.fullmatch(text)
        if match is None:
            return
        wants_checksum = match["checksum"] is not None
        if wants_checksum and checksum(text[1:].rpartition(":")[0]) != match["checksum"].upper():
            return
        self._apply_faults()
        numbers = [int(number) for number in match["numbers"].split()]
        address, axis = [*numbers, 0, 0][:2]
        message_id = f"{numbers[2]:02d} " if len(numbers) == 3 else ""
        for device in self.devices:
            if address in (0, device.address):
                self._answer(device, axis, message_id, match["words"].split(), sums=wants_checksum)

    def _answer(self, device: ZaberDevice, axis: int, message_id: str, words: list[str], *, sums: bool) -> None:
        try:
            if axis > 1:
                raise Rejected("BADAXIS")
            verdict, data = "OK", device.run(words)
        except Rejected as rejection:
            verdict, data = "RJ", str(rejection)
        state = "BUSY" if device.axis.is_moving() else "IDLE"
        flag = (device.flags() or ["--"])[0]
        body = f"{device.address:02d} {axis} {message_id}{verdict} {state} {flag} {data}"
        self._reply(_framed("@", body, sums and device.sums))

    def _do_make_foreign(self, reply: bytes) -> bytes:
        text = reply.decode("latin-1").strip()
        body, colon, _ = text[1:].partition(":")
        address = int(body[:2]) % 99 + 1
        return _framed(text[0], f"{address:02d}{body[2:]}", bool(colon))

    def _do_advance(self) -> None:
        for device in self.devices:
            if device.alerts_for is not None and not device.axis.is_moving():
                if device.settings.get("comm.alert") == "1":
                    flag = (device.flags() or ["--"])[0]
                    self._reply(_framed("!", f"{device.address:02d} {device.alerts_for} IDLE {flag}", False))
                device.alerts_for = None

    def _do_next_event_s(self) -> float | None:
        ends = [device.axis.end_s() for device in self.devices if device.alerts_for is not None]
        return min(ends) if ends else None


def _framed(mark: str, body: str, sums: bool) -> bytes:
    tail = f":{checksum(body)}" if sums else ""
    return f"{mark}{body}{tail}\r\n".encode("latin-1")


def make(options: ServeOptions) -> ZaberEmulator:
    """Three devices without a reference: 1 and 2 rotary without limits, 3 an arm from 0 to 190 degrees."""
    devices = []
    count = 3 if options.axes is None else options.axes
    for index in range(count):
        is_arm = index == 2
        low, high = options.limits_deg or ((0.0, 190.0) if is_arm else (None, None))
        start_deg = (37.0, 101.0, 20.0)[index % 3]
        devices.append(ZaberDevice(index + 1, options.axis(low, high, start_deg), serial_number=110_001 + index))
    return ZaberEmulator(devices, options.clock, options.faults)


def axis_configs(emulator: ZaberEmulator, port: str) -> list[Config]:
    """Rig entries for every device of a chain."""
    return [Config(port=port, serial_number=device.serial_number) for device in emulator.devices]


def make_without_checksums(options: ServeOptions) -> ZaberEmulator:
    """The same devices with `comm.checksum` 0."""
    emulator = make(options)
    for device in emulator.devices:
        device.sums = False
    return emulator


SERVES = {"zaber": make, "zaber-no-checksums": make_without_checksums}
