"""Standa 8SMC4 and 8SMC5 with stepper rotation stages, over USB (a serial port) or RS-232.

Facts: the protocol definition of Standa's own library libximc, its stage profiles, and the manual of the 8SMC5-USB; the
checksum also in the public driver `samps`. The library itself drives the emulator. `home` leaves the count as it is, so
the driver calls the home position zero; whether that was done, the controller cannot tell. How a stage finds its home
position is a setting of the controller (XILab), and so are speed, acceleration and borders. Refused: motors counted by
their encoder, whose speeds have another unit.
Unverified on hardware: everything; that `home` after `sstp` starts anew in the status, and what `zero` does to borders.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from pydantic import Field

from drivers.clock import Clock
from drivers.errors import CommandRejected, ReplyError, ReplyTimeout, WrongDevice
from drivers.serial_link import ControllerLine, LineRegistry, Transcript
from drivers.session_reference import SessionReferenceAxis, SessionReferenceConfig
from drivers.standa_frames import ERRORS, LAYOUTS, RESYNCHRONIZE, WRONG_VALUE, framer, message

COMMAND_NAME, COMMAND_FAILED, COMMAND_RUNS = 0x3F, 0x40, 0x80
HOME = 0x06
IS_HOMED, ALARM = 0x20, 0x40
STEPS_LOST = 0x80
# Bits of the controller's flags that say that something is wrong.
CONDITIONS = {
    ALARM: "alarm: the controller has switched itself off",
    STEPS_LOST: "position control: the motor lost steps",
    0x100: "power driver hot",
    0x200: "controller hot",
    0x400: "supply voltage high",
    0x800: "supply current high",
    0x8000: "limit switches exchanged",
    0x10000: "supply voltage low",
    0x20000: "bridge fault",
    0x100000: "windings differ",
    0x200000: "encoder fault",
    0x800000: "motor does not respond",
}
FAULTS = ALARM | STEPS_LOST
STEPPER = 3
COUNTED_BY_ENCODER = (1, 6)
BORDER_IS_A_COUNT, BORDER_STOPS_LEFT, BORDER_STOPS_RIGHT = 1, 2, 4
SPEED_IS_LIMITED = 0x80
# How long a controller may take to show a command in its status.
TAKE_UP_S = 2.0


class Config(SessionReferenceConfig):
    """A Standa axis in a rig file; every controller has its own port."""

    kind: Literal["standa"] = "standa"
    serial_number: int | None = Field(default=None, description="serial number; another device at this port is refused")
    steps_per_deg: float = Field(
        gt=0,
        description="full motor steps per degree of the stage, which the controller does not know: 8MR190-2-28: 100",
    )


class StandaLine(ControllerLine):
    """The port of one controller."""

    def __init__(self, config: Config, clock: Clock, transcript: Transcript | None) -> None:
        super().__init__(config, clock, transcript, framer, baudrate=115_200, two_stop_bits=True, reply_s=0.5)

    def ask(self, letters: bytes) -> tuple[Any, ...]:
        """Ask a question and return the values of the answer; once more if none came.

        Raises CommandRejected, ReplyTimeout, ReplyError.
        """
        with self.link.lock:
            try:
                answer = self._exchange(letters, b"")
            except (ReplyTimeout, ReplyError):
                self.link.write(RESYNCHRONIZE)
                self.link.purge()
                answer = self._exchange(letters, b"")
        return LAYOUTS[letters].unpack(answer[4:])

    def command(self, letters: bytes, data: bytes = b"") -> None:
        """Send a command, once; raises CommandRejected, ReplyTimeout or ReplyError."""
        with self.link.lock:
            self._exchange(letters, data)

    def _exchange(self, letters: bytes, data: bytes) -> bytes:
        label = f"Standa {self.link.port}, {letters.decode('ascii')}"
        # What waits here was not asked for now.
        self.link.purge(0.0)
        self.link.write(message(letters, data))
        frames: list[bytes] = []
        deadline_s = self.link.clock.now_s() + self.reply_s
        while (frame := self.link.read_frame(deadline_s)) is not None:
            if frame[:4] == letters:
                return frame
            if frame == WRONG_VALUE:
                raise CommandRejected(label, "errv: value out of range", "Check target and settings")
            # Of the other errors the line may be the cause.
            frames.append(frame)
            if frame in ERRORS:
                break
        if frames:
            raise ReplyError(label, f"no valid answer, but {[frame[:4] for frame in frames[:3]]}", "Check the cable")
        raise ReplyTimeout(label, f"nothing within {self.reply_s} s", "Check power and cable; is it an 8SMC4 or 8SMC5?")


@dataclass(frozen=True, slots=True)
class Status:
    """What `gets` tells: the last command and its state, the position in full and micro steps, the flags."""

    command: int
    steps: int
    microsteps: int
    flags: int

    @property
    def runs(self) -> bool:
        """True while the last command is carried out."""
        return bool(self.command & COMMAND_RUNS)

    @property
    def homes(self) -> bool:
        """True if the last command is `home`, whether it is done or not."""
        return self.command & COMMAND_NAME == HOME


class StandaAxis(SessionReferenceAxis):
    """The stepper stage of one controller."""

    def __init__(self, name: str, config: Config, line: StandaLine, lines: LineRegistry) -> None:
        super().__init__(name, config, lines.clock)
        self.config: Config = config
        self.line, self._lines = line, lines
        label = f"axis {name} on {config.port}"
        maker, _, product, *hardware = line.ask(b"geti")
        if maker != b"XIMC":
            raise WrongDevice(label, f"maker {maker!r}", "Correct `port` in the rig file")
        (serial_number,) = line.ask(b"gser")
        if config.serial_number not in (None, serial_number):
            raise WrongDevice(label, f"it has serial number {serial_number}", "Correct it in the rig file")
        (motor, _), (_, feedback, _, _) = line.ask(b"gent"), line.ask(b"gfbs")
        if motor != STEPPER or feedback in COUNTED_BY_ENCODER:
            raise WrongDevice(
                label,
                f"motor type {motor}, feedback {feedback}",
                "Only stepper motors counted in steps are driven here",
            )
        _, _, nominal, _, flags, _, microstep_mode, _ = line.ask(b"geng")
        self._microsteps: int = 1 << microstep_mode - 1
        self.counts_per_deg = config.steps_per_deg * self._microsteps
        speed, fraction, acceleration, deceleration, _, _ = line.ask(b"gmov")
        fast_home = line.ask(b"ghom")[0]
        limit = nominal if flags & SPEED_IS_LIMITED else math.inf
        self.speed_deg_s = min(speed + fraction / self._microsteps, limit) / config.steps_per_deg
        self.acceleration_deg_s2 = min(acceleration, deceleration) / config.steps_per_deg
        self._home_speed_deg_s = min(fast_home, limit) / config.steps_per_deg
        if min(self.speed_deg_s, self.acceleration_deg_s2, self._home_speed_deg_s) <= 0:
            raise ReplyError(
                f"{label}, speed", "speed, acceleration or homing speed is zero", "Load the stage's profile"
            )
        self._read_borders()
        self._identify(
            model=f"{product.rstrip(bytes(1)).decode('ascii', 'replace')} {'.'.join(map(str, hardware))}",
            serial_number=str(serial_number),
            firmware=".".join(map(str, line.ask(b"gfwv"))),
            address="",
        )

    def _read_borders(self) -> None:
        flags, _, low, micro_low, high, micro_high = self.line.ask(b"geds")
        if flags & BORDER_IS_A_COUNT and flags & BORDER_STOPS_LEFT:
            self._device_min_deg = (low + micro_low / self._microsteps) / self.config.steps_per_deg
        if flags & BORDER_IS_A_COUNT and flags & BORDER_STOPS_RIGHT:
            self._device_max_deg = (high + micro_high / self._microsteps) / self.config.steps_per_deg

    def _status(self) -> Status:
        values = self.line.ask(b"gets")
        return Status(command=values[1], steps=values[5], microsteps=values[6], flags=values[15])

    def _do_read_counts(self) -> int:
        status = self._status()
        return status.steps * self._microsteps + status.microsteps

    def _do_is_homed(self) -> bool:
        return super()._do_is_homed() and bool(self._status().flags & IS_HOMED)

    def _do_is_moving(self) -> bool:
        status = self._status()
        if status.runs:
            return True
        if self._homing and not self._saw_motion and status.homes and not status.command & COMMAND_FAILED:
            self.line.command(b"zero")
            self._saw_motion = True
        return False

    def _do_start_move(self, counts: float) -> None:
        self._begin_moving()
        # Both parts have the sign of the whole.
        steps = int(round(counts) / self._microsteps)
        data = LAYOUTS[b"move"].pack(steps, round(counts) - steps * self._microsteps)
        self.line.command(b"move", data)

    def _do_start_home(self) -> None:
        """Home, once the status no longer shows an earlier homing, which could be taken for the end of this one."""
        self._do_check_fault()
        if self._status().homes:
            self.line.command(b"sstp")
            self._wait_until_it_shows(homes=False)
        self._begin_homing()
        self.line.command(b"home")
        self._wait_until_it_shows(homes=True)

    def _wait_until_it_shows(self, homes: bool) -> None:
        give_up_s = self.clock.now_s() + TAKE_UP_S
        while self._status().homes != homes:
            if self.clock.now_s() > give_up_s:
                raise CommandRejected(
                    f"axis {self.name}, home", f"its status does not follow within {TAKE_UP_S:g} s", "Look at XILab"
                )
            self.clock.sleep_s(self.config.poll_s)

    def _do_stop(self) -> None:
        # Brakes: an abrupt stop of a stepper loses counts. Its reply is not waited for.
        self.line.link.write(message(b"sstp"))

    def _do_check_fault(self) -> None:
        status = self._status()
        words = _words(status.flags & FAULTS)
        if status.command & COMMAND_FAILED and not status.runs:
            words.append("the last motion ended with an error")
        if words:
            self._give_up_homing()
            raise CommandRejected(
                f"axis {self.name}, state", f"fault {', '.join(words)}", "Remove the cause; XILab's stop ends an alarm"
            )

    def _do_warnings(self) -> list[str]:
        return self._reference_warnings() + _words(self._status().flags & ~FAULTS)


def _words(flags: int) -> list[str]:
    return [words for bit, words in CONDITIONS.items() if flags & bit]


def open(name: str, config: Config, lines: LineRegistry) -> StandaAxis:
    """Open one axis; reads identity, speeds and borders and moves nothing."""
    with lines.taken(config.port, StandaLine, partial(StandaLine, config, lines.clock)) as line:
        return StandaAxis(name, config, line, lines)
