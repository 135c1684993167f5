"""Thorlabs APT units with a rotation stage: K10CR1, KDC101, KBD101; binary, with unsolicited messages."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Literal

from drivers.axes.apt import Config
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

HOST, UNIT = 0x01, 0x50
# A rack answers at 0x11 and its bays from 0x21 on; these units are single ones.
ADDRESSES = (UNIT, 0x11, 0x21)
UPDATE_EVERY_S = 0.1


class APTModel:
    """What differs between the models: name, serial number, scale (counts per deg, deg/s, deg/s^2), stage id."""

    def __init__(
        self, name: str, hardware_type: int, serial_number: int, scale: tuple[float, float, float], *, stage_id: int
    ) -> None:
        self.name = name
        self.hardware_type = hardware_type
        self.serial_number = serial_number
        self.per_deg, self.per_deg_s, self.per_deg_s2 = scale
        self.stage_id = stage_id
        # Brushed and brushless servos send the same status.
        self.is_dc = name.startswith(("KDC", "KBD"))


def k10cr1() -> APTModel:
    """Stepper rotation mount with its own controller."""
    return APTModel("K10CR1", 16, 55000001, (409600 / 3, 7329109.0, 1502.0), stage_id=0)


def kdc101() -> APTModel:
    """DC servo controller with a PRM1-Z8 stage."""
    per_deg, tick_s = 1919.6418578623391, 2048 / 6e6
    return APTModel(
        "KDC101", 44, 27000001, (per_deg, per_deg * 65536 * tick_s, per_deg * 65536 * tick_s**2), stage_id=6
    )


def kbd101() -> APTModel:
    """Brushless servo controller with a DDR25 stage, which it does not name."""
    per_deg, sample_s = 1_440_000 / 360, 102.4e-6
    return APTModel(
        "KBD101", 45, 28000001, (per_deg, per_deg * 65536 * sample_s, per_deg * 65536 * sample_s**2), stage_id=0
    )


class APTEmulator(Emulator):
    """One unit with one channel; `true_deg()` is the angle of its stage."""

    pieces = (
        b"\x53\x04\x06\x00\xd0\x01",
        b"\x43\x04\x01\x00\x50\x01",
        b"\x11\x00\x00\x00\x50\x01",
        b"\x50\x01",
        # A whole question so often that it is heard behind any length that noise has announced.
        b"\x11\x04\x01\x00\x50\x01" * 50,
    )
    tells_limits = False

    def __init__(
        self, model: APTModel, axis: EmulatedAxis, clock: FastClock, faults: FaultSchedule | None = None
    ) -> None:
        super().__init__([axis], clock, faults)
        self.model = model
        self.axis = axis
        self.enabled = True
        self.home_parameters = [2, 1, round(axis.speed_deg_s * model.per_deg_s), 0]
        # Settings that a host writes and reads back: id of the answer -> data behind the channel.
        self.stored = {
            0x0418: struct.pack("<Hiiiih", 2, self._counts(5.0), 0, 1000, 1000, 2),
            0x043C: struct.pack("<i", 0),
            0x0425: struct.pack("<HHiiH", 3, 3, 0, 0, 1),
            0x0428: struct.pack("<HH", 30, 30),
            0x0447: struct.pack("<i", self._counts(1.0)),
            0x0452: struct.pack("<i", 0),
            0x04A2: struct.pack("<iiiiH", 435, 195, 993, 195, 15),
            0x0525: struct.pack("<HHHH", 0, 1, 0, 1),
            0x0528: struct.pack("<8i", 0, 0, 1, 0, 0, 1, 50_000, 1),
        }
        self._moves_ends = 0
        self._home_ends = False
        self._updates_from_s: float | None = None
        self._buffer = bytearray()

    def _counts(self, deg: float) -> int:
        return round(deg * self.model.per_deg)

    def position(self) -> int:
        """Position counter, which overflows after 32 bits."""
        return (self._counts(self.axis.position_deg()) + (1 << 31)) % (1 << 32) - (1 << 31)

    def status_bits(self) -> int:
        """Status word."""
        axis = self.axis
        bits = 1 << 8 | 1 << 28 | (1 << 31 if self.enabled else 0)
        if axis.is_moving():
            # Both bits may be set, whatever the direction (qmi).
            bits |= 1 << 9 if axis.homing else 0b11_0000
            bits |= 1 << 29
        else:
            bits |= 1 << 13
        if axis.homed:
            bits |= 1 << 10
        return bits

    def _do_receive(self, data: bytes) -> None:
        self._buffer += data
        while len(self._buffer) >= 6:
            message_id, length, destination, source = struct.unpack_from("<HHBB", self._buffer)
            is_long = bool(destination & 0x80)
            if destination & 0x7F not in ADDRESSES or source != HOST or (is_long and length > 255):
                del self._buffer[0]
                continue
            total = 6 + (length if is_long else 0)
            if len(self._buffer) < total:
                return
            message = bytes(self._buffer[:total])
            del self._buffer[:total]
            if destination & 0x7F != 0x11:
                self._command(message_id, message)

    def _command(self, message_id: int, message: bytes) -> None:
        self._apply_faults()
        data = message[6:]
        handlers: dict[int, Callable[[bytes, bytes], None]] = {
            0x0005: lambda *_: self._send_long(0x0006, self._hardware_info()),
            0x0011: lambda *_: self._set_updates(True),
            0x0012: lambda *_: self._set_updates(False),
            0x0210: self._set_enabled,
            0x0211: lambda *_: self._send_short(0x0212, 1, 1 if self.enabled else 2),
            0x0410: self._set_position,
            0x0411: lambda *_: self._send_long(0x0412, struct.pack("<Hi", 1, self.position())),
            0x0429: lambda *_: self._send_long(0x042A, struct.pack("<HI", 1, self.status_bits())),
            0x0480: lambda *_: self._send_long(0x0481, self._stepper_status()),
            0x0490: lambda *_: self._send_long(0x0491, self._dc_status()),
            0x0413: self._set_velocity,
            0x0414: lambda *_: self._send_long(0x0415, self._velocity()),
            0x0440: self._set_home_parameters,
            0x0441: lambda *_: self._send_long(0x0442, struct.pack("<HHHii", 1, *self.home_parameters)),
            0x0443: self._home,
            0x0448: self._move_by,
            0x0453: self._move_to,
            0x0450: self._store,
            0x0457: self._run,
            0x0465: self._stop,
            0x046A: self._jog,
        }
        if message_id in handlers:
            handlers[message_id](message, data)
        elif message_id + 2 in self.stored or message_id + 1 in self.stored:
            self._store_or_tell(message_id, data)
        # A real unit does not answer what it does not know.

    def _send_short(self, message_id: int, first: int, second: int = 0) -> None:
        self._reply(struct.pack("<HBBBB", message_id, first, second, HOST, UNIT))

    def _send_long(self, message_id: int, data: bytes) -> None:
        self._reply(struct.pack("<HHBB", message_id, len(data), HOST | 0x80, UNIT) + data)

    def _hardware_info(self) -> bytes:
        model = self.model
        notes = b"APT unit (emulated)"
        # qmi and pylablib read hardware version, modification and channels from the last three words.
        return struct.pack(
            "<I8sH4s48s8sHHHHH", model.serial_number, model.name.encode()[:8], model.hardware_type, b"\x03\x00\x01\x00",
            notes, b"", 0, 0, 1, 1, 1,
        )[:76] + struct.pack("<HHHH", model.stage_id, 1, 1, 1)  # fmt: skip

    def _stepper_status(self) -> bytes:
        return struct.pack("<HiiI", 1, self.position(), 0, self.status_bits())

    def _dc_status(self) -> bytes:
        velocity = round(abs(self.axis.velocity_deg_s()) * self.model.per_deg_s / 65536) & 0xFFFF
        return struct.pack("<HiHHI", 1, self.position(), velocity, 0, self.status_bits())

    def _status(self) -> bytes:
        return self._dc_status() if self.model.is_dc else self._stepper_status()

    def _velocity(self) -> bytes:
        axis, model = self.axis, self.model
        acceleration = round(axis.acceleration_deg_s2 * model.per_deg_s2)
        return struct.pack("<Hiii", 1, 0, acceleration, round(axis.speed_deg_s * model.per_deg_s))

    def _set_velocity(self, _: bytes, data: bytes) -> None:
        if len(data) == 14:
            _, _, acceleration, velocity = struct.unpack("<Hiii", data)
            if acceleration > 0 and velocity > 0:
                self.axis.acceleration_deg_s2 = acceleration / self.model.per_deg_s2
                self.axis.speed_deg_s = velocity / self.model.per_deg_s

    def _set_position(self, _: bytes, data: bytes) -> None:
        if len(data) == 6 and not self.axis.is_moving():
            self.axis.call_position(struct.unpack("<Hi", data)[1] / self.model.per_deg)

    def _set_home_parameters(self, _: bytes, data: bytes) -> None:
        if len(data) == 14:
            self.home_parameters = list(struct.unpack_from("<HHii", data, 2))

    def _store_or_tell(self, message_id: int, data: bytes) -> None:
        """Settings come in threes: set n, request n + 1, answer n + 2."""
        if message_id + 2 in self.stored and len(data) == len(self.stored[message_id + 2]) + 2:
            self.stored[message_id + 2] = data[2:]
        elif message_id + 1 in self.stored:
            self._send_long(message_id + 1, struct.pack("<H", 1) + self.stored[message_id + 1])

    def _store(self, _: bytes, data: bytes) -> None:
        self._store_or_tell(0x0450, data)

    def _set_enabled(self, message: bytes, _: bytes) -> None:
        self.enabled = message[3] == 1

    def _set_updates(self, on: bool) -> None:
        self._updates_from_s = self.clock.now_s() if on else None

    def _home(self, *_: bytes) -> None:
        # A homing speed of zero makes homing look dead, as on the real unit.
        if self.enabled and self.home_parameters[2] > 0:
            self.axis.home()
            self._home_ends, self._moves_ends = True, 0

    def _go(self, target_deg: float) -> None:
        if self.enabled and self.axis.within(target_deg):
            self.axis.move_to(target_deg)
            self._moves_ends, self._home_ends = 0x0464, False

    def _move_to(self, _: bytes, data: bytes) -> None:
        if len(data) == 6:
            self._go(struct.unpack("<Hi", data)[1] / self.model.per_deg)

    def _move_by(self, _: bytes, data: bytes) -> None:
        if len(data) == 6:
            self._go(self.axis.position_deg() + struct.unpack("<Hi", data)[1] / self.model.per_deg)

    def _jog(self, message: bytes, _: bytes) -> None:
        step = struct.unpack_from("<Hi", self.stored[0x0418])[1] / self.model.per_deg
        self._go(self.axis.position_deg() + (step if message[3] == 1 else -step))

    def _run(self, message: bytes, _: bytes) -> None:
        if self.enabled:
            self.axis.run(self.axis.speed_deg_s if message[3] == 1 else -self.axis.speed_deg_s)

    def _stop(self, *_: bytes) -> None:
        self.axis.stop()
        self._moves_ends, self._home_ends = 0x0466, False

    def _do_make_foreign(self, reply: bytes) -> bytes:
        # The answer to another question: a channel state nobody asked for.
        return struct.pack("<HBBBB", 0x0212, 1, 1, HOST, 0x22)

    def _do_advance(self) -> None:
        moving = self.axis.is_moving()
        if self._home_ends and not moving:
            self._home_ends = False
            self._send_short(0x0444, 1)
        if self._moves_ends and not moving:
            message_id, self._moves_ends = self._moves_ends, 0
            self._send_long(message_id, self._status())
        if self._updates_from_s is not None and self.clock.now_s() >= self._updates_from_s + UPDATE_EVERY_S:
            self._updates_from_s = self.clock.now_s()
            self._send_long(0x0491 if self.model.is_dc else 0x0481, self._status())

    def _do_next_event_s(self) -> float | None:
        times = [self.axis.end_s()] if self._home_ends or self._moves_ends else []
        if self._updates_from_s is not None:
            times.append(self._updates_from_s + UPDATE_EVERY_S)
        return min(times) if times else None


def _make(options: ServeOptions, model: APTModel, start_deg: float) -> APTEmulator:
    low, high = options.limits_deg or (None, None)
    if options.axes not in (None, 1):
        raise ValueError("an APT unit has one axis, and a port of its own")
    if options.model is not None:
        model.name = options.model
    axis = options.axis(low, high, start_deg)
    # The protocol's 32 bits hold no more (293 deg/s on a K10CR1).
    axis.speed_deg_s = min(axis.speed_deg_s, 0.99 * 2**31 / model.per_deg_s)
    return APTEmulator(model, axis, options.clock, options.faults)


def make_k10cr1(options: ServeOptions) -> APTEmulator:
    """A K10CR1 with a serial number that starts with 55."""
    return _make(options, k10cr1(), 33.0)


def make_kdc101(options: ServeOptions) -> APTEmulator:
    """A KDC101 with a PRM1-Z8, serial number starting with 27."""
    return _make(options, kdc101(), 12.0)


def make_kbd101(options: ServeOptions) -> APTEmulator:
    """A KBD101 with a DDR25, serial number starting with 28."""
    return _make(options, kbd101(), 57.0)


def axis_configs(emulator: APTEmulator, port: str) -> list[Config]:
    """Rig entry for the unit."""
    stage: Literal["DDR25"] | None = "DDR25" if emulator.model.name == "KBD101" else None
    return [Config(port=port, serial_number=emulator.model.serial_number, stage=stage)]


SERVES = {"apt-k10cr1": make_k10cr1, "apt-kdc101": make_kdc101, "apt-kbd101": make_kbd101}
