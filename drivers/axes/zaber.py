"""Zaber rotary stages over Zaber ASCII (firmware 6/7), message ids and checksums on.

Facts: Zaber's "ASCII protocol" page, the libraries zaber.serial and zaber-motion, and traffic of the latter.
Unverified on hardware: the unit of speed and acceleration, which word goes with which rejection, and that a rotary
position does not wrap at a turn.
"""

import itertools
import re
from dataclasses import dataclass
from functools import partial
from typing import Literal

from pydantic import Field

from drivers.clock import Clock
from drivers.errors import CommandRejected, ReplyError, ReplyTimeout, WrongDevice
from drivers.motion import AxisConfig, MotionAxis
from drivers.serial_link import ControllerLine, LineRegistry, Transcript, agreed, line_framer

VELOCITY_UNIT = 1.6384  # native velocity per microstep/s (unverified)
ACCELERATION_UNIT = 1.6384 / 10_000  # native acceleration per microstep/s^2 (unverified)
# Limits as large as this are those of a rotary stage that has none.
NO_LIMIT = 1_000_000_000

# The vendor's flags (zaber-motion, ascii/warning_flags.py), in our words.
FLAGS = {
    "FF": "critical system error",
    "FN": "peripheral not supported",
    "FZ": "peripheral inactive",
    "FH": "hardware emergency stop",
    "FV": "driver over- or undervoltage",
    "FO": "driver disabled",
    "FC": "current inrush error",
    "FM": "motor temperature error",
    "FD": "driver disabled",
    "FQ": "encoder error",
    "FI": "index error",
    "FA": "analog encoder synchronization error",
    "FR": "overdrive limit exceeded",
    "FB": "stalled and stopped, with recovery failed",
    "FP": "excessive twist",
    "FT": "excessive drive temperature",
    "FE": "limit error",
    "FS": "stalled and stopped",
    "WR": "no reference position",
    "WH": "not homed since a change",
    "WL": "unexpected limit trigger",
    "WP": "invalid calibration",
    "WV": "voltage out of range",
    "WT": "temperature high",
    "WM": "displaced when stationary",
    "WS": "stalled with recovery",
    "NI": "movement interrupted",
    "NC": "manual control",
}
_REPLY = re.compile(r"@(\d\d) (\d) (\d\d) (OK|RJ) (IDLE|BUSY) (--|[A-Z0-9]{2}) ([^:]*)(?::([0-9A-Fa-f]{2}))?")


class Config(AxisConfig):
    """A Zaber axis in a rig file. Give `serial_number`: addresses are the order of the wiring."""

    kind: Literal["zaber"] = "zaber"
    address: int | None = Field(default=None, ge=1, le=99, description="address on the line")
    serial_number: int | None = Field(default=None, description="serial number; another device at this port is refused")
    axis: int = Field(default=1, ge=1, le=9, description="axis of a controller with several")
    counts_per_turn: float | None = Field(
        default=None, gt=0, description="microsteps per turn, for a stage that does not report limit.cycle.dist"
    )
    baudrate: int = Field(default=115_200, description="bits a second, as the controller is set")

    def place(self) -> str:
        device = f"serial number {self.serial_number}" if self.address is None else f"address {self.address}"
        return f"{device} axis {self.axis}"


@dataclass(frozen=True, slots=True)
class Reply:
    """A reply; `summed` says that it came with a checksum, and a checksum that is there is right."""

    address: int
    axis: int
    message_id: int
    accepted: bool
    busy: bool
    flag: str
    data: str
    summed: bool = True


def checksum(text: str) -> str:
    """Two's complement of the low byte of the sum of all characters, two upper-case hex digits."""
    return f"{-sum(text.encode('ascii')) & 0xFF:02X}"


def parse_reply(frame: bytes) -> Reply | None:
    """Read a reply line; None if it is not a whole reply, or its checksum is wrong."""
    text = frame.decode("ascii", "replace").rstrip()
    match = _REPLY.fullmatch(text)
    if match is None:
        return None
    summed = match[8] is not None
    if summed and checksum(text[1:-3].replace("\ufffd", "?")) != match[8].upper():
        return None
    numbers = int(match[1]), int(match[2]), int(match[3])
    return Reply(*numbers, match[4] == "OK", match[5] == "BUSY", match[6], match[7], summed)


class ZaberLine(ControllerLine):
    """One chain of devices: sends commands, gives each reply to its request by address, axis and id."""

    def __init__(self, config: Config, clock: Clock, transcript: Transcript | None) -> None:
        super().__init__(config, clock, transcript, line_framer, baudrate=config.baudrate, reply_s=0.5)
        # A stop from another thread takes an id at the same time: never the same one.
        self._message_ids = itertools.cycle(range(1, 100))
        # Devices set to answer without checksums (`comm.checksum` 0). From others such a reply is a damaged one.
        self._unsummed: set[int] = set()
        #: What came after the last question to all devices.
        self.heard: list[bytes] = []

    def send(self, address: int, axis: int, words: str) -> int:
        """Write a command and return its message id; takes no lock."""
        message_id = next(self._message_ids)
        body = f"{address} {axis} {message_id:02d} {words}".rstrip()
        self.link.write(f"/{body}:{checksum(body)}\n".encode("ascii"))
        return message_id

    def ask(self, address: int, axis: int, words: str, *, repeat: bool) -> Reply:
        """Send a command and return its reply.

        Parameters
        ----------
        repeat : ask a second time, after a purge, if no valid reply came. For questions only, never for a command.

        Raises
        ------
        CommandRejected, ReplyTimeout, ReplyError
        """
        with self.link.lock:
            reply, frames = self._exchange(address, axis, words, tries=2 if repeat else 1)
        request = f"Zaber {self.link.port} device {address}, {words or 'status'!r}"
        if reply is None and frames:
            raise ReplyError(
                request, f"no valid reply, but {frames[:3]}", "Check the cable and that every address occurs only once"
            )
        if reply is None:
            raise ReplyTimeout(
                request, f"nothing within {self.reply_s} s", "Check power, cable, address and the device's protocol"
            )
        if not reply.accepted:
            raise CommandRejected(request, f"rejected: {reply.data}", "Check the state of the device and the command")
        return reply

    def _exchange(self, address: int, axis: int, words: str, tries: int) -> tuple[Reply | None, list[bytes]]:
        frames: list[bytes] = []
        for _ in range(tries):
            message_id = self.send(address, axis, words)
            deadline_s = self.link.clock.now_s() + self.reply_s
            while (frame := self.link.read_frame(deadline_s)) is not None:
                reply = parse_reply(frame)
                if (
                    reply is not None
                    and (reply.address, reply.axis, reply.message_id) == (address, axis, message_id)
                    and (reply.summed or address in self._unsummed)
                ):
                    return reply, frames
                # Alerts (!), extra info (#), late replies and noise.
                frames.append(frame)
            self.link.purge()
        return None, frames

    def ask_all(self, words: str, quiet_s: float = 0.1) -> list[tuple[int, str]]:
        """Ask every device on the chain; returns addresses and data of the replies until the line is quiet."""
        replies: list[Reply] = []
        self.heard.clear()
        with self.link.lock:
            message_id = self.send(0, 0, words)
            deadline_s = self.link.clock.now_s() + self.reply_s
            while (frame := self.link.read_frame(deadline_s)) is not None:
                self.heard.append(frame)
                reply = parse_reply(frame)
                if reply is not None and reply.message_id == message_id and reply.accepted:
                    replies.append(reply)
                    deadline_s = self.link.clock.now_s() + quiet_s
            return sorted(
                (reply.address, reply.data)
                for reply in replies
                if reply.summed or self._sends_no_checksums(reply.address)
            )

    def _sends_no_checksums(self, address: int) -> bool:
        """True if the device itself says so, twice; its replies are believed without from then on.

        An old firmware that sends none does not know the setting: its rejection comes without a checksum as well.
        """
        if address not in self._unsummed:
            self._unsummed.add(address)
            settings = [self._exchange(address, 0, "get comm.checksum", tries=2)[0] for _ in range(2)]
            if not all(reply is not None and _says_no_checksums(reply) for reply in settings):
                self._unsummed.discard(address)
        return address in self._unsummed


def _says_no_checksums(reply: Reply) -> bool:
    return reply.data == "0" if reply.accepted else reply.data == "BADCOMMAND" and not reply.summed


class ZaberAxis(MotionAxis):
    """One axis of a Zaber device."""

    def __init__(self, name: str, config: Config, line: ZaberLine, lines: LineRegistry) -> None:
        super().__init__(name, config, lines.clock)
        self.config: Config = config
        self._line, self._lines = line, lines
        self._address, serial_number = self._find()
        turn = config.counts_per_turn or self._constant("limit.cycle.dist")
        self.counts_per_deg = turn / 360.0
        speed = self._constant("maxspeed")
        self.speed_deg_s = speed / VELOCITY_UNIT / self.counts_per_deg
        self.acceleration_deg_s2 = self._constant("accel") / ACCELERATION_UNIT / self.counts_per_deg
        # The vendor: an approach takes the lesser of the two speeds.
        approach = min(self._constant("limit.approach.maxspeed"), speed)
        self._home_speed_deg_s = approach / VELOCITY_UNIT / self.counts_per_deg
        if min(turn, self.speed_deg_s, self.acceleration_deg_s2, self._home_speed_deg_s) <= 0:
            raise ReplyError(
                f"axis {name}, turn, speed and acceleration", "one of them is zero", "Restore the defaults"
            )
        self._device_min_deg = self._limit("limit.min")
        self._device_max_deg = self._limit("limit.max")
        self._identify(
            model=f"device id {self._ask('get deviceid', axis=0).data}",
            serial_number=serial_number,
            firmware=self._ask("get version", axis=0).data,
            address=str(self._address),
        )

    def _find(self) -> tuple[int, str]:
        """Return address and serial number of the device that the rig file means."""
        config = self.config
        # An answer can be late: two readings of the chain have to agree, and silence is queried once more.
        ask = partial(self._line.ask_all, "get system.serial")
        devices = agreed(ask) or agreed(ask)
        listing = ", ".join(f"address {address}: serial {serial}" for address, serial in devices)
        request = f"axis {self.name}, find Zaber device on {config.port}"
        if not devices and self._line.heard:
            raise ReplyError(
                request,
                f"no valid reply, but {self._line.heard[:3]}",
                "Check baudrate, and that the chain speaks Zaber ASCII with message ids",
            )
        if not devices:
            raise ReplyTimeout(request, "no device answers", "Check power, cable and that the chain speaks Zaber ASCII")
        if len({address for address, _ in devices}) < len(devices):
            raise WrongDevice(request, f"two devices have one address ({listing})", "Renumber the chain")
        matches = [
            (address, serial)
            for address, serial in devices
            if config.address in (None, address) and str(config.serial_number or serial) == serial
        ]
        if len(matches) != 1:
            criteria = {"address": config.address, "serial_number": config.serial_number}
            rule = ", ".join(f"{key} {value}" for key, value in criteria.items() if value is not None)
            mismatch = f"no device has {rule}" if rule else f"{len(matches)} devices answer and the rig file names none"
            raise WrongDevice(request, f"{mismatch}; found {listing}", "Correct the rig file or the wiring")
        return matches[0]

    def _ask(self, words: str, *, axis: int | None = None, repeat: bool = True) -> Reply:
        return self._line.ask(self._address, self.config.axis if axis is None else axis, words, repeat=repeat)

    def _get(self, setting: str) -> int:
        data = self._ask(f"get {setting}").data
        if not re.fullmatch(r"-?\d+(\.\d+)?", data):
            raise ReplyError(
                f"axis {self.name}, get {setting}", f"not a number: {data!r}", "Check the firmware version"
            )
        return round(float(data))

    def _constant(self, setting: str) -> int:
        return agreed(lambda: self._get(setting))

    def _limit(self, setting: str) -> float | None:
        counts = self._constant(setting)
        return None if abs(counts) >= NO_LIMIT else counts / self.counts_per_deg

    def _do_read_counts(self) -> int:
        return self._get("pos")

    def _flags(self) -> list[str]:
        words = self._ask("warnings").data.split()
        return words[1:]

    def _do_is_homed(self) -> bool:
        return "WR" not in self._flags()

    def _do_is_moving(self) -> bool:
        return self._ask("").busy

    def _do_start_move(self, counts: float) -> None:
        self._ask(f"move abs {round(counts)}", repeat=False)

    def _do_start_home(self) -> None:
        self._ask("home", repeat=False)

    def _do_stop(self) -> None:
        self._line.send(self._address, self.config.axis, "stop")

    def _do_check_fault(self) -> None:
        faults = [flag for flag in self._flags() if flag.startswith("F")]
        if faults:
            words = ", ".join(f"{flag} {FLAGS.get(flag, '')}".strip() for flag in faults)
            raise CommandRejected(
                f"axis {self.name}, state", f"fault {words}", "Remove the cause; the vendor's manual lists the flags"
            )

    def _do_warnings(self) -> list[str]:
        return [f"{flag} {FLAGS.get(flag, 'unknown flag')}" for flag in self._flags()]


def open(name: str, config: Config, lines: LineRegistry) -> ZaberAxis:
    """Open one axis; reads its identity, limits and speed and moves nothing."""
    with lines.taken(config.port, ZaberLine, partial(ZaberLine, config, lines.clock)) as line:
        return ZaberAxis(name, config, line, lines)
