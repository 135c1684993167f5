"""The memory of Aravis' fake camera, as a look into the camera from behind: registers, numbers and texts."""

from __future__ import annotations

import struct
from typing import Any

from simulators.camera import gige_features as features
from simulators.camera.node_map import NodeMap

# Frames start on this grid. A finer one shortens the wait, but Aravis spins through the last millisecond of each.
_GRID_HZ = 100.0
_NUMBERS = {"Gain": features.GAIN_DB, "BlackLevel": features.BLACK_LEVEL}
_RAW_NUMBERS = {"GainRaw": features.GAIN_RAW, "BlackLevelRaw": features.BLACK_LEVEL_RAW}


class CameraMemory:
    """Registers of one camera, 32 bits each; `fake` is the `Aravis.FakeCamera`.

    Attributes
    ----------
    address : int
        Address of the object in this process, for calls that PyGObject cannot make.
    """

    def __init__(self, fake: Any) -> None:
        self._fake = fake
        # hash() of a GObject wrapper is the object's address.
        self.address = hash(fake)

    def read(self, address: int) -> int:
        """Read a register."""
        return int(self._fake.read_register(address)[1])

    def write(self, address: int, value: int) -> None:
        """Write a register."""
        self._fake.write_register(address, value)

    def number(self, name: str) -> float:
        """Read Gain, GainRaw, BlackLevel or BlackLevelRaw."""
        if name in _RAW_NUMBERS:
            return float(self.read(_RAW_NUMBERS[name]))
        address = _NUMBERS[name]
        return float(struct.unpack(">d", struct.pack(">II", self.read(address), self.read(address + 4)))[0])

    def write_number(self, address: int, number: float) -> None:
        """Write a 64-bit number."""
        for offset, part in zip((0, 4), struct.unpack(">II", struct.pack(">d", number)), strict=True):
            self.write(address + offset, part)

    def write_text(self, address: int, text: str) -> None:
        """Write a text of 32 bytes."""
        for offset, part in zip(range(0, 32, 4), struct.unpack(">8I", text.encode().ljust(32, b"\0")), strict=True):
            self.write(address + offset, part)

    def power_up(self, width: int, height: int, table: NodeMap | None) -> None:
        """Set what a camera is set to when it is switched on: automatic modes and gamma on, the whole sensor."""
        self._fake.set_trigger_frequency(_GRID_HZ)
        codes = table.codes() if table else {}
        start = "Mono16" if "Mono16" in codes or table is None else table.pixel_formats[0]
        for address, value in (
            (features.SENSOR_WIDTH, width),
            (features.SENSOR_HEIGHT, height),
            (features.WIDTH, width),
            (features.HEIGHT, height),
            (features.PIXEL_FORMAT, codes.get(start, 0x01100007)),
            (features.GAIN_AUTO, 2),
            (features.GAMMA_ENABLE, 1),
            (features.DECIMATION_X, 1),
            (features.DECIMATION_Y, 1),
            (features.TRIGGER_ARMED, 1),
            (features.FRAME_RATE_ENABLE, 1),
        ):
            self.write(address, value)
        for address, number in (
            (features.GAIN_DB, 0.0),
            (features.BLACK_LEVEL, 0.0),
            (features.TEMPERATURE_C, 38.5),
            (features.GAMMA, 0.45),
        ):
            self.write_number(address, number)
        if table is not None:
            self.write_text(features.VENDOR_NAME, table.vendor)
            self.write_text(features.MODEL_NAME, table.model)
