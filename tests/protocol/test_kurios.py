"""KURIOS tunable filter: byte transcripts, the band BLACK, and what is refused."""

from collections.abc import Iterator

import pytest

from drivers.errors import DeviceError, WrongDevice
from drivers.serial_link import LineRegistry
from drivers.sources import kurios, sc10
from simulators.clock import FastClock, patient_clock
from simulators.controllers.kurios import KuriosEmulator
from simulators.controllers.sc10 import SC10Emulator
from simulators.serial.pty_port import PtyPort


@pytest.fixture
def head() -> Iterator[tuple[KuriosEmulator, str, LineRegistry]]:
    emulator = KuriosEmulator(FastClock(base=patient_clock()))
    with PtyPort(emulator) as port, LineRegistry(clock=patient_clock()) as lines:
        yield emulator, port.path, lines


def test_bytes_of_the_filter() -> None:
    emulator = KuriosEmulator(FastClock(instant=True))
    for sent, came in (
        (b"\r", b"CMD_NOT_DEFINED\r>"),
        (b"*idn?\r", b"THORLABS KURIOS-VB1 SN-00001234 HW1.0 FW2.1 CN-00005678\r>"),
        (b"SP?\r", b"WLmax=730.000\rWLmin=420.000\r>"),
        (b"OH?\r", b"OH=271\r>"),
        (b"WL=662\r", b">"),
        (b"WL?\r", b"WL=662.000\r>"),
        (b"WL=900\r", b"CMD_ARG_INVALID\r>"),
        (b"BW=3\r", b"CMD_ARG_INVALID\r>"),
        (b"ST?\r", b"ST=2\r>"),
    ):
        emulator.receive(sent)
        assert emulator.take_output() == came


def test_any_wavelength_of_its_range_in_the_band_of_the_rig_file(
    head: tuple[KuriosEmulator, str, LineRegistry],
) -> None:
    emulator, path, lines = head
    emulator.values["OM"] = 3
    source = kurios.open(kurios.Config(port=path, band="narrow", settle_s=0.0), lines)
    source.select(613.5)
    assert not source.is_on()
    source.set_light(True)
    assert emulator.values | {"TP": 0} == {"OM": 1, "WL": 613.5, "BW": 8, "ST": 2, "TP": 0, "OH": 271}
    assert (emulator.light_at(613.0), emulator.light_at(620.0)) == (1.0, 0.0)
    with pytest.raises(DeviceError, match="420 to 730 nm"):
        source.select(780.0)
    source.set_light(False)
    assert emulator.light_at(613.0) == 0.0


def test_a_head_without_black_needs_a_shutter(head: tuple[KuriosEmulator, str, LineRegistry]) -> None:
    emulator, path, lines = head
    emulator.values |= {"OH": 0x0102, "BW": 2}
    with pytest.raises(WrongDevice, match="no band BLACK"):
        kurios.open(kurios.Config(port=path), lines)
    with pytest.raises(WrongDevice, match="band narrow"):
        kurios.open(kurios.Config(port=path, band="narrow"), lines)
    blade = SC10Emulator(FastClock(base=patient_clock()))
    with PtyPort(blade) as port:
        source = kurios.open(kurios.Config(port=path, shutter=sc10.Config(port=port.path), settle_s=0.0), lines)
        source.select(500.0)
        source.set_light(True)
        assert (source.is_on(), blade.is_open(), source.interlock_open()) == (True, True, False)
        source.set_light(False)
        assert (source.is_on(), blade.is_open(), emulator.values["BW"]) == (False, False, 2)
        assert "SC10" in source.describe()["shutter"]
        source.close()


def test_it_is_not_used_while_it_warms_up(head: tuple[KuriosEmulator, str, LineRegistry]) -> None:
    emulator, path, lines = head
    source = kurios.open(kurios.Config(port=path), lines)
    emulator.values["ST"] = 1
    for call in (lambda: source.select(500.0), lambda: source.set_light(True)):
        with pytest.raises(DeviceError, match="warms up"):
            call()
