"""Thorlabs APT units with a rotation stage, alone or in the bays of a rack; binary, with unsolicited messages."""

import struct
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from drivers.apt_frames import BAY, HOST, RACK, UNIT
from drivers.axes.apt import Config
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

UPDATE_EVERY_S = 0.1
BAYS_OF_A_RACK = 10


class APTModel:
    """What differs between the models: name, serial number, scale (counts per deg, deg/s, deg/s^2), stage id.

    Attributes
    ----------
    stage : what a rig file must say of the stage.
    """

    def __init__(
        self,
        name: str,
        hardware_type: int,
        serial_number: int,
        scale: tuple[float, float, float],
        *,
        stage_id: int = 0,
        stage: str | None = None,
    ) -> None:
        self.name = name
        self.hardware_type = hardware_type
        self.serial_number = serial_number
        self.per_deg, self.per_deg_s, self.per_deg_s2 = scale
        self.stage_id = stage_id
        self.stage = stage
        self.is_rack = name.startswith(("BSC2", "BBD2"))
        # Brushed and brushless servos send the same status.
        self.is_dc = name.startswith(("KDC", "KBD", "BBD"))
        # Words for a second channel, and the host's address as 0 in the parameters of jogging (PnPQ).
        self.is_k10cr2 = name == "K10CR2"


def _servo(counts_per_deg: float, sample_s: float) -> tuple[float, float, float]:
    return counts_per_deg, counts_per_deg * 65536 * sample_s, counts_per_deg * 65536 * sample_s**2


MOUNT = (409600 / 3, 7329109.0, 1502.0)
# Worm gear 66:1.
HEAVY = (409600 * 66 / 360, 409600 * 66 / 360 * 53.68, 409600 * 66 / 360 * 53.68 * 204.94e-6)
MODELS: dict[str, Callable[[], APTModel]] = {
    "apt-k10cr1": lambda: APTModel("K10CR1", 16, 55000001, MOUNT),
    "apt-k10cr2": lambda: APTModel("K10CR2", 16, 55500001, MOUNT),
    "apt-kdc101": lambda: APTModel("KDC101", 44, 27000001, _servo(1919.6418578623391, 2048 / 6e6), stage_id=6),
    "apt-kbd101": lambda: APTModel("KBD101", 45, 28000001, _servo(4000.0, 102.4e-6), stage="DDR25"),
    "apt-kst101": lambda: APTModel("KST101", 16, 26000001, HEAVY, stage="HDR50"),
    "apt-bsc203": lambda: APTModel("BSC203", 16, 70000001, HEAVY, stage="HDR50"),
    "apt-bbd203": lambda: APTModel("BBD203", 45, 73000001, _servo(3_276_800 / 360, 102.4e-6), stage="DDR100"),
}
START_DEG = {"apt-k10cr1": 33.0, "apt-kdc101": 12.0, "apt-kbd101": 57.0}


class APTUnit:
    """One unit with one channel and one address.

    Parameters
    ----------
    send : gets the bytes that the unit sends.
    """

    def __init__(self, model: APTModel, axis: EmulatedAxis, address: int, send: Callable[[bytes], None]) -> None:
        self.model = model
        self.axis = axis
        self.address = address
        self._send = send
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
            # Both bits may be set, in either direction (qmi).
            bits |= 1 << 9 if axis.homing else 0b11_0000
            bits |= 1 << 29
        else:
            bits |= 1 << 13
        if axis.homed:
            bits |= 1 << 10
        return bits

    def command(self, message_id: int, message: bytes) -> None:
        """Do one message; a real unit does not answer an unknown one."""
        data = message[6:]
        handlers: dict[int, Callable[[bytes, bytes], None]] = {
            0x0005: lambda *_: self._send_long(0x0006, hardware_info(self.model)),
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
            self._store_or_send(message_id, data)

    def _send_short(self, message_id: int, first: int, second: int = 0) -> None:
        self._send(struct.pack("<HBBBB", message_id, first, second, HOST, self.address))

    def _send_long(self, message_id: int, data: bytes) -> None:
        host = 0 if self.model.is_k10cr2 and message_id == 0x0418 else HOST
        self._send(struct.pack("<HHBB", message_id, len(data), host | 0x80, self.address) + data)

    def _stepper_status(self) -> bytes:
        more = struct.pack("<Hiii", 1, 0, 0, 0) if self.model.is_k10cr2 else b""
        return struct.pack("<HiiI", 1, self.position(), 0, self.status_bits()) + more

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

    def _store_or_send(self, message_id: int, data: bytes) -> None:
        """Settings come in threes: set n, request n + 1, answer n + 2."""
        if message_id + 2 in self.stored and len(data) == len(self.stored[message_id + 2]) + 2:
            self.stored[message_id + 2] = data[2:]
        elif message_id + 1 in self.stored:
            self._send_long(message_id + 1, struct.pack("<H", 1) + self.stored[message_id + 1])

    def _store(self, _: bytes, data: bytes) -> None:
        self._store_or_send(0x0450, data)

    def _set_enabled(self, message: bytes, _: bytes) -> None:
        self.enabled = message[3] == 1

    def _set_updates(self, on: bool) -> None:
        self._updates_from_s = self.axis.clock.now_s() if on else None

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

    def advance(self) -> None:
        """Send the due messages: the end of a motion, the periodic status."""
        moving, now_s = self.axis.is_moving(), self.axis.clock.now_s()
        if self._home_ends and not moving:
            self._home_ends = False
            self._send_short(0x0444, 1)
        if self._moves_ends and not moving:
            message_id, self._moves_ends = self._moves_ends, 0
            self._send_long(message_id, self._status())
        if self._updates_from_s is not None and now_s >= self._updates_from_s + UPDATE_EVERY_S:
            self._updates_from_s = now_s
            self._send_long(0x0491 if self.model.is_dc else 0x0481, self._status())

    def events_s(self) -> list[float]:
        """Simulated times at which it has something to say."""
        times = [self.axis.end_s()] if self._home_ends or self._moves_ends else []
        if self._updates_from_s is not None:
            times.append(self._updates_from_s + UPDATE_EVERY_S)
        return times


def hardware_info(model: APTModel) -> bytes:
    """Answer of a unit or of a rack to the request for its identity."""
    notes = b"APT unit (emulated)"
    # qmi and pylablib read hardware version, modification and channels from the last three words.
    return struct.pack(
        "<I8sH4s48s8sHHHHH", model.serial_number, model.name.encode()[:8], model.hardware_type, b"\x03\x00\x01\x00",
        notes, b"", 0, 0, 1, 1, 1,
    )[:76] + struct.pack("<HHHH", model.stage_id, 1, 1, 1)  # fmt: skip


class APTEmulator(Emulator):
    """One unit, or a rack with a unit in each of its first bays; `true_deg(i)` is the angle of the i-th stage."""

    pieces = (
        b"\x53\x04\x06\x00\xd0\x01",
        b"\x43\x04\x01\x00\x50\x01",
        b"\x11\x00\x00\x00\x50\x01",
        b"\x50\x01",
        # A whole question so often that it is heard behind any length that noise has announced.
        b"\x11\x04\x01\x00\x50\x01" * 50,
        b"\x11\x04\x01\x00\x21\x01" * 50,
    )
    tells_limits = False

    def __init__(
        self, model: APTModel, axes: Sequence[EmulatedAxis], clock: FastClock, faults: FaultSchedule | None = None
    ) -> None:
        super().__init__(axes, clock, faults)
        self.model = model
        first = BAY if model.is_rack else UNIT
        self.units = [APTUnit(model, axis, first + index, self._reply) for index, axis in enumerate(axes)]
        # A single unit also listens to the addresses of a rack's first bay.
        self._unit_at = {unit.address: unit for unit in self.units}
        if not model.is_rack:
            self._unit_at[BAY] = self.units[0]
        self._buffer = bytearray()

    def _do_receive(self, data: bytes) -> None:
        self._buffer += data
        while len(self._buffer) >= 6:
            message_id, length, destination, source = struct.unpack_from("<HHBB", self._buffer)
            is_long = bool(destination & 0x80)
            if destination & 0x7F not in (RACK, *self._unit_at) or source != HOST or (is_long and length > 255):
                del self._buffer[0]
                continue
            total = 6 + (length if is_long else 0)
            if len(self._buffer) < total:
                return
            message = bytes(self._buffer[:total])
            del self._buffer[:total]
            self._apply_faults()
            if destination & 0x7F in self._unit_at:
                self._unit_at[destination & 0x7F].command(message_id, message)
            elif self.model.is_rack:
                self._rack(message_id, message)

    def _rack(self, message_id: int, message: bytes) -> None:
        """Answers of the rack itself: its identity, and the bays that hold a unit."""
        if message_id == 0x0005:
            info = hardware_info(self.model)
            self._reply(struct.pack("<HHBB", 0x0006, len(info), HOST | 0x80, RACK) + info)
        elif message_id == 0x0060 and message[2] < BAYS_OF_A_RACK:
            state = 1 if message[2] < len(self.units) else 2
            self._reply(struct.pack("<HBBBB", 0x0061, message[2], state, HOST, RACK))

    def _do_make_foreign(self, reply: bytes) -> bytes:
        # The answer to another question: the state of a channel.
        return struct.pack("<HBBBB", 0x0212, 1, 1, HOST, 0x22)

    def _do_advance(self) -> None:
        for unit in self.units:
            unit.advance()

    def _do_next_event_s(self) -> float | None:
        return min((time_s for unit in self.units for time_s in unit.events_s()), default=None)


def _make(kind: str, options: ServeOptions) -> APTEmulator:
    low, high = options.limits_deg or (None, None)
    model = MODELS[kind]()
    count = options.axes or 1
    if count > (3 if model.is_rack else 1):
        raise ValueError("an APT unit has one axis, and a port of its own; a rack has up to three")
    if options.model is not None:
        model.name = options.model
    axes = [options.axis(low, high, START_DEG.get(kind, 20.0)) for _ in range(count)]
    for axis in axes:
        # The protocol's 32 bits hold no more (293 deg/s on a K10CR1).
        axis.speed_deg_s = min(axis.speed_deg_s, 0.99 * 2**31 / model.per_deg_s)
    return APTEmulator(model, axes, options.clock, options.faults)


def axis_configs(emulator: APTEmulator, port: str) -> list[Config]:
    """Rig entries for the unit, or for every unit of the rack."""
    model = emulator.model
    entry: dict[str, Any] = {"port": port, "serial_number": model.serial_number, "stage": model.stage}
    bays = range(1, len(emulator.units) + 1) if model.is_rack else (None,)
    return [Config(**entry, bay=bay) for bay in bays]


SERVES = {kind: partial(_make, kind) for kind in MODELS}
