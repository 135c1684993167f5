"""Thorlabs Elliptec rotation mounts ELL14 and ELL18 on a multi-drop line.

Facts: Thorlabs' ELL18K manual, public drivers (pylablib, elliptec, tl_elliptec) and captures of real units. A
module says at the end of a move where it is, once; it cannot be stopped in between, and it cannot say whether it
was ever homed. Assumed, not read: 430 deg/s at full velocity (vendor's specification) and 2000 deg/s^2, used for
deadlines only.
"""

import logging
import re
from collections import Counter
from functools import partial
from typing import Literal

from pydantic import Field

from drivers.clock import Clock
from drivers.errors import CommandRejected, ReplyError, ReplyTimeout, WrongDevice
from drivers.serial_link import ControllerLine, LineRegistry, Transcript, agreed, line_framer
from drivers.session_reference import SessionReferenceAxis, SessionReferenceConfig

log = logging.getLogger(__name__)

STATUS = {
    0: "ok",
    1: "communication timeout",
    2: "mechanical timeout",
    3: "command error or not supported",
    4: "value out of range",
    5: "module isolated",
    6: "module out of isolation",
    7: "initialising",
    8: "thermal error",
    9: "busy",
    10: "sensor error",
    11: "motor error",
    12: "out of range",
    13: "over-current",
}
BUSY = 9
FULL_SPEED_DEG_S = 430.0
ACCELERATION_DEG_S2 = 2000.0
_ROTARY = {14: "ELL14", 18: "ELL18"}
_FRAME = re.compile(r"([0-9A-F])([A-Z][A-Z0-9])([0-9A-F]*)")


class Config(SessionReferenceConfig):
    """An Elliptec module in a rig file. Without `address` the line is searched for `serial_number`."""

    kind: Literal["elliptec"] = "elliptec"
    address: str | None = Field(default=None, pattern="^[0-9A-F]$", description="address on the line")
    serial_number: str | None = Field(default=None, description="serial number; another device at this port is refused")
    home_clockwise: bool = Field(default=True, description="whether homing turns clockwise")
    pause_before_move_s: float = Field(
        default=0.1, ge=0, description="pylablib notes that a move sent too soon after another command can end at zero"
    )

    def place(self) -> str:
        return f"serial number {self.serial_number}" if self.address is None else f"address {self.address}"


class ElliptecLine(ControllerLine):
    """Up to 16 modules on one line; replies are sorted by address and letters."""

    def __init__(self, config: Config, clock: Clock, transcript: Transcript | None) -> None:
        super().__init__(config, clock, transcript, line_framer, baudrate=9600, reply_s=0.6)
        # Last unsolicited message of each module: the end of its move.
        self.ended: dict[str, tuple[str, str]] = {}
        self._unanswered_stops: Counter[str] = Counter()
        self._last_sent_s = -float("inf")

    def send(self, address: str, command: str) -> None:
        """Write a command; takes no lock."""
        self.link.write(f"{address}{command}".encode("ascii"))
        self._last_sent_s = self.link.clock.now_s()

    def start(self, address: str, command: str, pause_s: float) -> None:
        """Start a move, whose reply comes when it ends."""
        with self.link.lock:
            self.link.clock.sleep_s(self._last_sent_s + pause_s - self.link.clock.now_s())
            self.drain()
            self.ended.pop(address, None)
            self.send(address, command)

    def stop(self, address: str) -> None:
        """Write a stop; takes no lock. Its answer, a status, is neither the end of a move nor that of a question."""
        self._unanswered_stops[address] += 1
        self.send(address, "st")

    def drain(self) -> None:
        """Sort what has arrived without waiting."""
        with self.link.lock:
            while (frame := self.link.read_frame(0.0)) is not None:
                self._note(*_parse(frame))

    def _answers_a_stop(self, address: str, letters: str) -> bool:
        answers = letters == "GS" and self._unanswered_stops[address] > 0
        if answers:
            self._unanswered_stops[address] -= 1
        return answers

    def _note(self, address: str, letters: str, data: str) -> None:
        """Store an unsolicited message of a module: the end of its move, or an error that ended it."""
        if self._answers_a_stop(address, letters):
            return
        if (letters == "PO" and len(data) == 8) or (
            letters == "GS" and len(data) == 2 and int(data, 16) not in (0, BUSY)
        ):
            self.ended[address] = (letters, data)

    def ask(self, address: str, command: str, letters: str, digits: int, *, tries: int = 2) -> str:
        """Ask a question and return the hex digits of the reply with these letters.

        Raises
        ------
        CommandRejected
            The module answered with a status that is an error, or it is busy.
        ReplyTimeout, ReplyError
        """
        request = f"Elliptec {self.link.port} address {address}, {command}"
        frames: list[bytes] = []
        for _ in range(tries):
            with self.link.lock:
                self.drain()
                self.send(address, command)
                deadline_s = self.link.clock.now_s() + self.reply_s
                while (frame := self.link.read_frame(deadline_s)) is not None:
                    sender, mnemonic, data = _parse(frame)
                    if self._answers_a_stop(sender, mnemonic):
                        continue
                    if (sender, mnemonic) == (address, letters) and len(data) >= digits:
                        return data
                    if (sender, mnemonic) == (address, "GS") and len(data) == 2 and int(data, 16) != 0:
                        code = int(data, 16)
                        word = STATUS.get(code, "unknown")
                        raise CommandRejected(request, f"status {code}: {word}", "Look at the module")
                    self._note(sender, mnemonic, data)
                    frames.append(frame)
                self.link.purge()
                self._unanswered_stops.clear()
        if frames:
            raise ReplyError(request, f"no valid reply, but {frames[:3]}", "Check cable, and that addresses differ")
        raise ReplyTimeout(request, f"nothing within {self.reply_s} s", "Check power, cable and address")


def _parse(frame: bytes) -> tuple[str, str, str]:
    """Return address, letters and hex digits; empty strings for noise."""
    match = _FRAME.fullmatch(frame.decode("ascii", "replace"))
    return ("", "", "") if match is None else (match[1], match[2], match[3])


class ElliptecAxis(SessionReferenceAxis):
    """One rotation mount. A started move runs to its end: `stop` cannot end it."""

    can_stop_a_move = False
    _reads_while_moving = False

    def __init__(self, name: str, config: Config, line: ElliptecLine, lines: LineRegistry) -> None:
        super().__init__(name, config, lines.clock)
        self.config: Config = config
        self._line, self._lines = line, lines
        self._in_motion = False
        self._status = 0
        self._address, info = self._find()
        module = int(info[0:2], 16)
        travel, pulses = int(info[18:22], 16), int(info[22:30], 16)
        if travel == 0 or pulses == 0:
            raise ReplyError(f"axis {name}, identify", f"travel {travel}, pulses {pulses}", "Is it a rotation mount?")
        if module in (7, 10, 17, 20):
            raise WrongDevice(f"axis {name}, identify", f"ELL{module} is a linear stage", "Correct the rig file")
        self._is_listed = module in _ROTARY
        # The field is pulses for the whole travel of a turn, whatever the manual calls it.
        self.counts_per_deg = pulses / travel
        velocity = int(agreed(lambda: line.ask(self._address, "gv", "GV", 2)), 16)
        self.speed_deg_s = FULL_SPEED_DEG_S * max(velocity, 1) / 100
        self.acceleration_deg_s2 = ACCELERATION_DEG_S2
        self._identify(
            model=_ROTARY.get(module, f"ELL{module}"),
            serial_number=info[2:10],
            firmware=info[14:16],
            address=self._address,
        )

    def _find(self) -> tuple[str, str]:
        config, line = self.config, self._line
        modules: dict[str, str] = {}
        for _ in range(2):
            for address in config.address or "0123456789ABCDEF":
                try:
                    modules[address] = agreed(
                        partial(line.ask, address, "in", "IN", 30, tries=2 if config.address else 1)
                    )
                except ReplyTimeout:
                    if config.address is not None:
                        raise
            matches = [item for item in modules.items() if config.serial_number in (None, item[1][2:10])]
            # An answer can be late: all addresses are queried again while the module is missing.
            if matches:
                break
        request = f"axis {self.name}, find Elliptec module on {config.port}"
        listing = ", ".join(f"address {address}: serial {info[2:10]}" for address, info in modules.items()) or "none"
        if len(matches) != 1:
            rule = f"address {config.address}, serial_number {config.serial_number}"
            raise WrongDevice(request, f"{len(matches)} modules match {rule}; found {listing}", "Correct the rig file")
        return matches[0]

    def _do_read_counts(self) -> int:
        value = int(self._line.ask(self._address, "gp", "PO", 8), 16)
        return value - (1 << 32) if value >= 1 << 31 else value

    def _do_is_moving(self) -> bool:
        self._line.drain()
        # The message at the end can be lost or late: the status decides, and without that message a single "idle"
        # is not believed.
        for _ in range(2 if self._in_motion and not self._take_end() else 1):
            status = int(self._line.ask(self._address, "gs", "GS", 2), 16)
            if status == BUSY:
                self._saw_motion = True
                return True
            self._status = status or self._status
        self._take_end()
        self._in_motion = False
        return False

    def _take_end(self) -> bool:
        """Take note of the module's message at the end of its move, if it has come."""
        end = self._line.ended.pop(self._address, None) if self._in_motion else None
        if end is None:
            return False
        letters, data = end
        if letters == "PO":
            self._saw_motion = True
        else:
            self._status = int(data, 16)
        return True

    def _do_start_move(self, counts: float) -> None:
        self._begin_moving()
        self._start(f"ma{round(counts) & 0xFFFFFFFF:08X}")

    def _do_start_home(self) -> None:
        self._begin_homing()
        self._start("ho0" if self.config.home_clockwise else "ho1")

    def _start(self, command: str) -> None:
        self._status = 0
        self._in_motion = True
        self._line.start(self._address, command, self.config.pause_before_move_s)

    def _do_stop(self) -> None:
        log.warning("axis %s: an Elliptec module runs a started move to its end, it cannot be stopped", self.name)
        self._line.stop(self._address)

    def _do_check_fault(self) -> None:
        if self._status:
            status, self._status = self._status, 0
            self._give_up_homing()
            raise CommandRejected(
                f"axis {self.name}, state", f"status {status}: {STATUS.get(status, 'unknown')}", "Is the mount free?"
            )

    def _do_warnings(self) -> list[str]:
        words = self._reference_warnings()
        if not self._is_listed:
            words.append(f"model {self._identity.model} is not known here, treated as ELL14")
        return words


def open(name: str, config: Config, lines: LineRegistry) -> ElliptecAxis:
    """Open one module; reads its identity and velocity and moves nothing."""
    with lines.taken(config.port, ElliptecLine, partial(ElliptecLine, config, lines.clock)) as line:
        return ElliptecAxis(name, config, line, lines)
