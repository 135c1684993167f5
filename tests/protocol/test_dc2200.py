"""DC2200 LED driver: SCPI transcripts, one LED at a time, and a device file that is read by messages."""

import os
import pty
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.errors import CommandRejected, DeviceError, PortLost, PortNotFound
from drivers.message_device import MessageDevice
from drivers.serial_link import LineRegistry
from drivers.sources import dc2200
from simulators.clock import FastClock, patient_clock
from simulators.controllers.dc2200 import DC2200Emulator
from simulators.serial.pty_port import PtyPort


@pytest.fixture
def box() -> Iterator[tuple[DC2200Emulator, str, LineRegistry]]:
    emulator = DC2200Emulator(FastClock(base=patient_clock()))
    with PtyPort(emulator) as port, LineRegistry(clock=patient_clock()) as lines:
        yield emulator, port.path, lines


def test_scpi_of_the_box() -> None:
    emulator = DC2200Emulator(FastClock())
    for sent, came in (
        (b"*IDN?\n", b"THORLABS,DC2200,M00960538,1.5.0\n"),
        (b"SOURCE1:MODE CB\nSYSTem:ERRor?\n", b'0,"No error"\n'),
        (b"SOURce1:CBRightness:BRIGhtness:AMPLitude 40\n", b""),
        (b"SOURce1:CBRightness:BRIGhtness:AMPLitude?\n", b"40.0\n"),
        (b"OUTPUT1:STATE ON\nOUTPut1:STATe?\n", b"1\n"),
        (b"SOURce:MODe?\n", b"CB\n"),
        (
            b"SOURce1:CBRightness:BRIGhtness:AMPLitude 140\nSYSTem:ERRor?\nSYSTem:ERRor?\n",
            b'-222,"Error"\n0,"No error"\n',
        ),
        (b"FLY\nSYSTem:ERRor?\n", b'-113,"Error"\n'),
        # SCPI: AMPLitude may be missing, and a word may be cut to its capitals.
        (b"SOURCE1:CBRIGHTNESS:BRIGHTNESS 12.5\nSOUR1:CBR:BRIG:AMPL?\nSYST:ERR?\n", b'12.5\n0,"No error"\n'),
        (b"SOURCE1:CBRIGHTNESS:BRIGHTNESS 40\nSOURCE1:CBRIGHTNESS:BRIGHTNESS:AMPLITUDE?\n", b"40.0\n"),
    ):
        emulator.receive(sent)
        assert emulator.take_output() == came
    assert emulator.light_at(662.0) == pytest.approx(0.4)


def test_one_led_at_a_time(box: tuple[DC2200Emulator, str, LineRegistry]) -> None:
    emulator, path, lines = box
    config = dc2200.Config(port=path, terminals={662.0: 1, 451.0: 2}, percent={662.0: 40.0, 451.0: 80.0})
    source = dc2200.open(config, lines)
    with pytest.raises(DeviceError, match="no wavelength was selected"):
        source.set_light(True)
    source.select(662.0)
    source.set_light(True)
    assert (emulator.light_at(662.0), emulator.light_at(451.0)) == (pytest.approx(0.4), 0.0)
    source.select(451.0)
    assert (emulator.light_at(662.0), emulator.light_at(451.0)) == (0.0, pytest.approx(0.8))
    source.set_light(False)
    assert not source.is_on()
    with pytest.raises(CommandRejected, match="0 to 100"):
        source.set_level(120.0)
    with pytest.raises(DeviceError, match="its LEDs are 662, 451 nm"):
        source.select(947.0)


def test_a_device_file_that_is_not_there_or_goes_away(tmp_path: Path) -> None:
    with pytest.raises(PortNotFound, match="USBTMC devices found"):
        MessageDevice(str(tmp_path / "usbtmc7"))
    master, slave = pty.openpty()
    tty.setraw(slave)
    device = MessageDevice(os.ttyname(slave), patient_clock())
    os.close(slave)
    os.write(master, b"one\ntwo\r\nthree\rfour\r")
    assert [device.read(0.2) for _ in range(4)] == ["one", "two", "three", "four"]
    assert device.read(0.05) is None
    os.close(master)
    with pytest.raises(PortLost, match="gone"):
        device.write("*IDN?")
    device.close()
    device.close()
