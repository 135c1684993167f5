"""A Standa 8SMC5 with a stepper rotation stage of 100 steps a degree: counts from where it was switched on."""

import struct
from collections.abc import Callable

from drivers.axes.standa import (
    ALARM,
    BORDER_IS_A_COUNT,
    BORDER_STOPS_LEFT,
    BORDER_STOPS_RIGHT,
    COMMAND_RUNS,
    HOME,
    IS_HOMED,
    STEPPER,
    Config,
)
from drivers.standa_frames import ECHOED, LAYOUTS, UNKNOWN_COMMAND, WRONG_CHECKSUM, WRONG_VALUE, checksum, message
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

STEPS_PER_DEG = 100
MICROSTEP_MODE = 9
MICROSTEPS = 256
SERIAL_NUMBER = 27_182
MOVE, MOVE_BY, LEFT, RIGHT, STOP, LOOSEN, SOFT_STOP = 1, 2, 3, 4, 5, 7, 8
SET_POSITION, IGNORE_POSITION = struct.Struct("<ihqB5x"), 0x01
NO_FEEDBACK, INTEGRATED_DRIVER = 5, 2
LIMITED_SPEED_WITH_RAMPS = 0x90
GAP_S = 0.4
# Bytes behind the letters of settings that the maker's library reads back and the emulator ignores.
KEPT = {
    b"pwr": 14, b"sec": 22, b"pid": 42, b"sni": 22, b"sno": 10, b"eio": 12, b"brk": 19, b"ctl": 87, b"joy": 16,
    b"ctp": 12, b"urt": 10, b"nmf": 24, b"nvm": 30, b"emf": 42, b"eas": 48, b"est": 40, b"nme": 24,
}  # fmt: skip
# Answered with the letters alone, and without effect on the angle: power, memory, measurement.
TAKEN = frozenset((b"pwof", b"save", b"read", b"sars", b"rers", b"eesv", b"eerd", b"stms"))
# Bytes of read-only data: measurements, chart.
READ_ONLY = {b"getm": 210, b"getc": 32}


class StandaEmulator(Emulator):
    """One controller, one stage.

    Attributes
    ----------
    settings : values of the settings by the last three letters of the commands that read and write them.
    alarm : motions are taken and not carried out, until `stop`.
    """

    pieces = (b"move", b"movr\x00\x01", b"home", b"sstp", b"gets", b"geng", b"smov", bytes(24), b"zero", b"gser")

    def __init__(self, axis: EmulatedAxis, clock: FastClock, faults: FaultSchedule | None = None) -> None:
        super().__init__([axis], clock, faults)
        self.axis = axis
        self.alarm = False
        self._command_name = 0
        self._zero_deg = axis.mechanical_deg()
        self._buffer = bytearray()
        self._last_byte_s = 0.0
        self._memory = {name: bytes(size) for name, size in KEPT.items()}
        speed, acceleration = (
            round(value * STEPS_PER_DEG) for value in (axis.speed_deg_s, min(axis.acceleration_deg_s2, 600.0))
        )
        left, right = (round((end or 0.0) * STEPS_PER_DEG) for end in (axis.min_deg, axis.max_deg))
        self.settings: dict[bytes, tuple[int, ...]] = {
            b"mov": (speed, 0, acceleration, acceleration, speed, 0),
            b"eng": (360, 670, max(speed, 4800), 0, LIMITED_SPEED_WITH_RAMPS, 1800, MICROSTEP_MODE, 200),
            b"ent": (STEPPER, INTEGRATED_DRIVER),
            b"fbs": (4000, NO_FEEDBACK, 0, 4000),
            b"eds": (0 if axis.min_deg is None else 7, 6, left, 0, right, 0),
            b"hom": (speed // 4, 0, max(speed // 40, 1), 0, 0, 0, 0x170),
        }

    def count_deg(self) -> float:
        """The present count, in degrees of the stage."""
        return self.axis.mechanical_deg() - self._zero_deg

    def _do_receive(self, data: bytes) -> None:
        now_s = self.clock.base.now_s()
        if now_s - self._last_byte_s > GAP_S:
            self._buffer.clear()
        self._last_byte_s = now_s
        self._buffer += data
        while self._take_command():
            pass

    def _take_command(self) -> bool:
        """Take a whole command off the buffer; False if there is none."""
        if self._buffer[:1] == b"\0":
            del self._buffer[0]
            self._reply(b"\0")
            return True
        if len(self._buffer) < 4:
            return False
        letters = bytes(self._buffer[:4])
        layout = LAYOUTS.get(b"g" + letters[1:]) if letters[:1] == b"s" else None
        if letters in (b"move", b"movr"):
            layout = LAYOUTS[b"move"]
        elif letters == b"spos":
            layout = SET_POSITION
        if letters[:1] == b"s" and letters[1:] in KEPT:
            size = KEPT[letters[1:]] + 2
        elif letters == b"asia":
            size = 18
        else:
            size = 0 if layout is None else layout.size + 2
        if len(self._buffer) < 4 + size:
            return False
        data = bytes(self._buffer[4 : 4 + size])
        del self._buffer[: 4 + size]
        self._apply_faults()
        if not data:
            self._reply(self._answer(letters))
        elif checksum(data[:-2]) != data[-2:]:
            self._reply(WRONG_CHECKSUM)
        elif layout is None:
            if letters != b"asia":
                self._memory[letters[1:]] = data[:-2]
            self._reply(letters)
        else:
            self._reply(self._set(letters, layout.unpack(data[:-2])))
        return True

    def _answer(self, letters: bytes) -> bytes:
        if letters in ECHOED or letters in (b"left", b"rigt", b"loft"):
            self._act(letters)
            return letters
        if letters in TAKEN:
            return letters
        questions: dict[bytes, Callable[[], tuple[object, ...]]] = {
            b"gets": self._status,
            b"gpos": lambda: (*self._steps(), 0),
            b"geti": lambda: (b"XIMC", b"SM", b"8SMC5-US", 2, 3, 0),
            b"gser": lambda: (SERIAL_NUMBER,),
            b"gfwv": lambda: (4, 7, 8),
            b"gblv": lambda: (4, 0, 9),
        }
        if letters in questions:
            # Both versions have one layout.
            layout = LAYOUTS[b"gfwv" if letters == b"gblv" else letters]
            return message(letters, layout.pack(*questions[letters]()))
        if letters in READ_ONLY:
            return message(letters, bytes(READ_ONLY[letters]))
        if letters[:1] == b"g" and letters[1:] in self._memory:
            return message(letters, self._memory[letters[1:]])
        if letters[:1] == b"g" and letters[1:] in self.settings:
            return message(letters, LAYOUTS[letters].pack(*self.settings[letters[1:]]))
        return UNKNOWN_COMMAND

    def _steps(self) -> tuple[int, int]:
        """Full and micro steps, both with the sign of the whole."""
        total = round(self.count_deg() * STEPS_PER_DEG * MICROSTEPS)
        steps = int(total / MICROSTEPS)
        return steps, total - steps * MICROSTEPS

    def _status(self) -> tuple[int, ...]:
        moving = self.axis.is_moving()
        speed = round(self.axis.velocity_deg_s() * STEPS_PER_DEG)
        flags = (IS_HOMED if self.axis.homed else 0) | (ALARM if self.alarm else 0)
        command = self._command_name | (COMMAND_RUNS if moving else 0)
        state = (int(moving), command, 3, 0, 0x33)
        return (*state, *self._steps(), 0, speed, 0, 5, 3600, 199, 503, 366, flags, 0, 0)

    def _act(self, letters: bytes) -> None:
        if letters == b"zero":
            if not self.axis.is_moving():
                self._zero_deg = self.axis.mechanical_deg()
            return
        if letters == b"stop":
            self.alarm = False
        if self.alarm:
            return
        if letters == b"home":
            self.axis.home(self.settings[b"hom"][0] / STEPS_PER_DEG)
        elif letters in (b"left", b"rigt"):
            self.axis.run(self.axis.speed_deg_s if letters == b"rigt" else -self.axis.speed_deg_s)
        else:
            self.axis.stop()
        names = {b"home": HOME, b"stop": STOP, b"sstp": SOFT_STOP, b"left": LEFT, b"rigt": RIGHT, b"loft": LOOSEN}
        self._command_name = names[letters]

    def _set(self, letters: bytes, values: tuple[int, ...]) -> bytes:
        if letters in (b"move", b"movr"):
            by_deg = (values[0] + values[1] / MICROSTEPS) / STEPS_PER_DEG
            self._move_to(by_deg + (self.count_deg() if letters == b"movr" else 0.0))
            if not self.alarm:
                self._command_name = MOVE if letters == b"move" else MOVE_BY
        elif letters == b"spos":
            if not values[3] & IGNORE_POSITION and not self.axis.is_moving():
                called_deg = (values[0] + values[1] / MICROSTEPS) / STEPS_PER_DEG
                self._zero_deg = self.axis.mechanical_deg() - called_deg
        elif letters == b"smov":
            if values[0] > 100_000 or 0 in values[2:4]:
                return WRONG_VALUE
            self.settings[b"mov"] = values
            self.axis.speed_deg_s = values[0] / STEPS_PER_DEG
        else:
            self.settings[letters[1:]] = values
        return letters

    def _move_to(self, target_deg: float) -> None:
        if self.alarm:
            return
        flags, _, left, micro_left, right, micro_right = self.settings[b"eds"]
        if flags & BORDER_IS_A_COUNT and flags & BORDER_STOPS_LEFT:
            target_deg = max(target_deg, (left + micro_left / MICROSTEPS) / STEPS_PER_DEG)
        if flags & BORDER_IS_A_COUNT and flags & BORDER_STOPS_RIGHT:
            target_deg = min(target_deg, (right + micro_right / MICROSTEPS) / STEPS_PER_DEG)
        origin_deg = self.axis.mechanical_deg() - self.axis.position_deg()
        self.axis.move_to(target_deg + self._zero_deg - origin_deg)

    def _do_make_foreign(self, reply: bytes) -> bytes:
        # The answer to another question.
        return message(b"gser", LAYOUTS[b"gser"].pack(77))


def make(options: ServeOptions) -> StandaEmulator:
    """One stage without borders, not homed."""
    if options.axes not in (None, 1):
        raise ValueError("an 8SMC5 has one axis, and a port of its own")
    low, high = options.limits_deg or (None, None)
    return StandaEmulator(options.axis(low, high, 25.0), options.clock, options.faults)


def axis_configs(emulator: StandaEmulator, port: str) -> list[Config]:
    """The rig entry of the stage."""
    return [Config(port=port, serial_number=SERIAL_NUMBER, steps_per_deg=STEPS_PER_DEG)]


SERVES = {"standa": make}
