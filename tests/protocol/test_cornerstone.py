"""Cornerstone monochromators: the bytes of the manual, with and without an echo, and what is refused."""

import pytest

from drivers.errors import CommandRejected, DeviceError, WrongDevice
from drivers.serial_link import LineRegistry
from drivers.sources import cornerstone
from simulators.clock import FastClock, patient_clock
from simulators.controllers.cornerstone import CornerstoneEmulator
from simulators.serial.pty_port import PtyPort
from simulators.serial.reply_faults import Fault
from tests.protocol.scripted import scripted


def test_bytes_of_the_instrument() -> None:
    emulator = CornerstoneEmulator(FastClock(instant=True))
    for sent, came in (
        (b"GOWAVE 500\n", b"GOWAVE 500\r\n"),
        (b"wave?\r\n", b"WAVE?\r\n500.000\r\n"),
        (b"SHUTTER O\n", b"SHUTTER O\r\n"),
        (b"SHUTTER?\n", b"SHUTTER?\r\nO\r\n"),
        (b"GOWAVE 5000\n", b"GOWAVE 5000\r\n"),
        (b"STB?\n", b"STB?\r\n32\r\n"),
        (b"ERROR?\n", b"ERROR?\r\n3\r\n"),
        (b"ERROR?\n", b"ERROR?\r\n0\r\n"),
        (b"FLY\nERROR?\n", b"FLY\r\nERROR?\r\n1\r\n"),
        (b"GOWAVE x\nERROR?\n", b"GOWAVE X\r\nERROR?\r\n2\r\n"),
    ):
        emulator.receive(sent)
        assert emulator.take_output() == came


# As the manuals have it: RS-232 repeats the statement, USB does not.
@pytest.mark.parametrize("echo", [True, False])
def test_bytes_of_the_driver(echo: bool) -> None:
    def exchange(sent: bytes, answer: bytes = b"") -> tuple[bytes, bytes]:
        return sent + b"\r\n", (sent + b"\r\n") * echo + (answer + b"\r\n" if answer else b"")

    none = exchange(b"ERROR?", b"0")
    with (
        scripted(
            exchange(b"INFO?", b"Oriel Instruments, 74100, SN123, 5.02"),
            none,
            exchange(b"GOWAVE 662.000"),
            none,
            *[exchange(b"WAVE?", b"662.01")] * 2,
            none,
            exchange(b"SHUTTER O"),
            none,
            *[exchange(b"SHUTTER?", b"O")] * 2,
        ) as path,
        LineRegistry(clock=patient_clock()) as lines,
    ):
        source = cornerstone.open(cornerstone.Config(port=path, range_nm=(350, 1000), reply_s=0.5), lines)
        source.select(662.0)
        source.set_light(True)


def test_what_the_instrument_cannot_do_is_refused_by_name() -> None:
    emulator = CornerstoneEmulator(FastClock(base=patient_clock()))
    with PtyPort(emulator) as port, LineRegistry(clock=patient_clock()) as lines:
        source = cornerstone.open(cornerstone.Config(port=port.path, range_nm=(350, 2000), move_s=0.2), lines)
        with pytest.raises(DeviceError, match="350 to 2000 nm"):
            source.select(300.0)
        with pytest.raises(CommandRejected, match="error 3: destination not allowed"):
            source.select(1900.0)
        source.select(524.0)
        source.set_light(True)
        assert (emulator.light_at(526.0), emulator.light_at(540.0)) == (1.0, 0.0)
        emulator.faults.add(Fault("stuck"))
        with pytest.raises(DeviceError, match="did not follow"):
            source.set_light(False)


def test_another_instrument_is_named() -> None:
    named = pytest.raises(WrongDevice, match="'Lamp 3000' is no Cornerstone")
    with scripted((b"INFO?\r\n", b"Lamp 3000\r\n")) as path, LineRegistry(clock=patient_clock()) as lines, named:
        cornerstone.open(cornerstone.Config(port=path, range_nm=(350, 1000)), lines)
