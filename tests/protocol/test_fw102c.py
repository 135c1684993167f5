"""FW102C filter wheel: byte transcripts, filters that choose the wavelength, and two ways to make dark."""

from collections.abc import Iterator

import pytest
from pydantic import BaseModel, ValidationError

from drivers.errors import DeviceError, WrongDevice
from drivers.serial_link import LineRegistry
from drivers.sources import dc2200, dc4100, fw102c, sc10
from simulators.clock import FastClock, patient_clock
from simulators.controllers.fw102c import FW102CEmulator
from simulators.controllers.sc10 import SC10Emulator
from simulators.serial.emulator import Emulator
from simulators.serial.pty_port import PtyPort

POSITIONS = {451.0: 1, 662.0: 3}


@pytest.fixture
def wheel() -> Iterator[tuple[FW102CEmulator, str, LineRegistry]]:
    emulator = FW102CEmulator(FastClock(100.0, base=patient_clock()))
    with PtyPort(emulator) as port, LineRegistry(clock=patient_clock()) as lines:
        yield emulator, port.path, lines


def test_bytes_of_the_wheel() -> None:
    emulator = FW102CEmulator(FastClock(instant=True), step_s=0.0)
    for sent, came in (
        (b"*idn?\r", b"*idn?\rTHORLABS FW102C/FW212C Filter Wheel version 1.07\r> "),
        (b"pos?\r", b"pos?\r6\r> "),
        (b"pos=3\r", b"pos=3\r> "),
        (b"pos?\r", b"pos?\r3\r> "),
        (b"pcount?\r", b"pcount?\r6\r> "),
        (b"pos=9\r", b"pos=9\rCommand error CMD_NOT_DEFINED\r> "),
    ):
        emulator.receive(sent)
        assert emulator.take_output() == came


class OtherLineEnds:
    """An emulator behind a terminal server that changes CR."""

    def __init__(self, emulator: Emulator, line_end: bytes) -> None:
        self._emulator, self._line_end = emulator, line_end
        self.receive, self.next_output_s = emulator.receive, emulator.next_output_s

    def take_output(self) -> bytes:
        return self._emulator.take_output().replace(b"\r", self._line_end)


@pytest.mark.parametrize("line_end", [b"\n", b"\r\n", b"\n\r"])
def test_lines_that_end_otherwise(line_end: bytes) -> None:
    emulator = FW102CEmulator(FastClock(100.0, base=patient_clock()))
    with (
        PtyPort(OtherLineEnds(emulator, line_end)) as port,
        LineRegistry(clock=patient_clock()) as lines,
    ):
        source = fw102c.open(fw102c.Config(port=port.path, positions=POSITIONS, dark_position=6), lines)
        source.select(662.0)
        source.set_light(True)
        assert source.is_on()
        assert emulator.light_at(662.0) == 1.0


def test_the_filter_of_the_wavelength_stands_in_the_beam(wheel: tuple[FW102CEmulator, str, LineRegistry]) -> None:
    emulator, path, lines = wheel
    source = fw102c.open(fw102c.Config(port=path, positions=POSITIONS, dark_position=6), lines)
    with pytest.raises(DeviceError, match="no wavelength was selected"):
        source.set_light(True)
    source.select(662.0)
    assert not source.is_on()
    source.set_light(True)
    assert (emulator.light_at(662.0), emulator.light_at(451.0)) == (1.0, 0.0)
    source.select(451.0)
    assert (emulator.light_at(662.0), emulator.light_at(451.0)) == (0.0, 1.0)
    source.set_light(False)
    assert (emulator.light_at(662.0), emulator.light_at(451.0)) == (0.0, 0.0)
    with pytest.raises(DeviceError, match="its filters are 451, 662 nm"):
        source.select(524.0)


def test_a_shutter_beside_the_wheel_makes_dark(wheel: tuple[FW102CEmulator, str, LineRegistry]) -> None:
    emulator, path, lines = wheel
    box = SC10Emulator(FastClock(base=patient_clock()))
    with PtyPort(box) as port:
        shutter = sc10.Config(port=port.path)
        source = fw102c.open(fw102c.Config(port=path, positions=POSITIONS, shutter=shutter), lines)
        source.select(662.0)
        assert emulator.light_at(662.0) == 1.0
        assert not source.is_on()
        source.set_light(True)
        assert box.is_open()
        assert source.is_on()
        box.trip(True)
        assert source.interlock_open()
        source.close()


def test_a_blocked_wheel_and_a_wrong_one_are_told(wheel: tuple[FW102CEmulator, str, LineRegistry]) -> None:
    emulator, path, lines = wheel
    with pytest.raises(WrongDevice, match="the wheel has 6"):
        fw102c.open(fw102c.Config(port=path, positions={662.0: 9}, dark_position=6), lines)
    source = fw102c.open(fw102c.Config(port=path, positions=POSITIONS, dark_position=6), lines)
    source.select(662.0)
    emulator.blocked = True
    with pytest.raises(DeviceError, match="stands at 6"):
        source.set_light(True)


@pytest.mark.parametrize(
    "wrong",
    [
        {"positions": POSITIONS},
        {"positions": POSITIONS, "dark_position": 3},
        {"positions": POSITIONS, "dark_position": 6, "shutter": {"kind": "sc10", "port": "x"}},
        {"positions": {}, "dark_position": 6},
    ],
)
def test_a_wheel_that_cannot_be_meant_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        fw102c.Config(port="x", **wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("config", "wrong", "says"),
    [
        (fw102c.Config, {"positions": {451: 1, 662: 1}, "dark_position": 6}, "position 1 is that of 451 nm and of 662"),
        (dc2200.Config, {"terminals": {451: 2, 662: 2}}, "terminal 2 is that of 451 nm and of 662 nm"),
        (dc2200.Config, {"terminals": {662: 2}, "percent": {626: 50}}, "given for 626 nm, and the wavelengths are 662"),
        (dc4100.Config, {"channels": {451: 1, 662: 1}}, "channel 1 is that of 451 nm and of 662 nm"),
        (dc4100.Config, {"channels": {451: 5}}, "less than or equal to 4"),
        (dc4100.Config, {"channels": {451: 1}, "percent": {450: 50}}, "given for 450 nm, and the wavelengths are 451"),
    ],
)
def test_one_place_for_each_wavelength(config: type[BaseModel], wrong: dict[str, object], says: str) -> None:
    with pytest.raises(ValidationError, match=says):
        config(port="/dev/ttyUSB0", **wrong)
