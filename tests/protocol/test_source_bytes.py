"""Light sources on the wire: bytes of manuals and of makers' adapters, what is refused, and ways to make dark."""

import os
import pty
import time
import tty
from pathlib import Path

import pytest
from pydantic import BaseModel, ValidationError

from drivers.errors import CommandRejected, DeviceError, PortLost, PortNotFound, WrongDevice
from drivers.message_device import MessageDevice
from drivers.serial_link import LineRegistry
from drivers.sources import cornerstone, dc2200, dc4100, fw102c, i7000, kurios, sc10
from simulators.clock import FastClock, patient_clock
from simulators.controllers.cornerstone import CornerstoneEmulator
from simulators.controllers.dc2200 import DC2200Emulator
from simulators.controllers.fw102c import FW102CEmulator
from simulators.controllers.i7000 import I7060Emulator
from simulators.controllers.kurios import KuriosEmulator
from simulators.controllers.sc10 import SC10Emulator
from simulators.serial.pty_port import PtyPort
from simulators.serial.reply_faults import Fault
from tests.protocol.scripted import scripted, served

#: What a client writes and what the emulator answers, in this order.
EMULATED = {
    "cornerstone": (
        lambda: CornerstoneEmulator(FastClock(instant=True)),
        [
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
        ],
    ),
    "dc2200": (
        lambda: DC2200Emulator(FastClock()),
        [
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
        ],
    ),
    "kurios": (
        lambda: KuriosEmulator(FastClock(instant=True)),
        [
            (b"\r", b"CMD_NOT_DEFINED\r>"),
            (b"*idn?\r", b"THORLABS KURIOS-VB1 SN-00001234 HW1.0 FW2.1 CN-00005678\r>"),
            (b"SP?\r", b"WLmax=730.000\rWLmin=420.000\r>"),
            (b"OH?\r", b"OH=271\r>"),
            (b"WL=662\r", b">"),
            (b"WL?\r", b"WL=662.000\r>"),
            (b"WL=900\r", b"CMD_ARG_INVALID\r>"),
            (b"BW=3\r", b"CMD_ARG_INVALID\r>"),
            (b"ST?\r", b"ST=2\r>"),
        ],
    ),
    "fw102c": (
        lambda: FW102CEmulator(FastClock(instant=True), step_s=0.0),
        [
            (b"*idn?\r", b"*idn?\rTHORLABS FW102C/FW212C Filter Wheel version 1.07\r> "),
            (b"pos?\r", b"pos?\r6\r> "),
            (b"pos=3\r", b"pos=3\r> "),
            (b"pos?\r", b"pos?\r3\r> "),
            (b"pcount?\r", b"pcount?\r6\r> "),
            (b"pos=9\r", b"pos=9\rCommand error CMD_NOT_DEFINED\r> "),
        ],
    ),
}


@pytest.mark.parametrize("kind", EMULATED)
def test_bytes_of_the_emulator(kind: str) -> None:
    make, exchanges = EMULATED[kind]
    emulator = make()
    for request, reply in exchanges:
        emulator.receive(request)
        assert emulator.take_output() == reply


# --- Cornerstone -----


# As the manuals have it: RS-232 repeats the statement, USB does not.
@pytest.mark.parametrize("echo", [True, False])
def test_bytes_to_a_cornerstone(echo: bool) -> None:
    def exchange(sent: bytes, answer: bytes = b"") -> tuple[bytes, bytes]:
        return sent + b"\r\n", (sent + b"\r\n") * echo + (answer + b"\r\n" if answer else b"")

    none = exchange(b"ERROR?", b"0")
    with scripted(
        *[exchange(b"INFO?", b"Oriel Instruments, 74100, SN123, 5.02")] * 2,
        none,
        exchange(b"GOWAVE 662.000"),
        none,
        *[exchange(b"WAVE?", b"662.01")] * 2,
        none,
        exchange(b"SHUTTER O"),
        none,
        *[exchange(b"SHUTTER?", b"O")] * 2,
    ) as (path, lines):
        source = cornerstone.open(cornerstone.Config(port=path, range_nm=(350, 1000), reply_s=0.5), lines)
        source.select(662.0)
        source.set_light(True)


def test_what_a_cornerstone_cannot_do_is_refused_by_name() -> None:
    emulator = CornerstoneEmulator(FastClock(base=patient_clock()))
    with served(emulator) as (path, lines):
        source = cornerstone.open(cornerstone.Config(port=path, range_nm=(350, 2000), move_s=0.2), lines)
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


def test_a_dc2200_drives_one_led_at_a_time() -> None:
    emulator = DC2200Emulator(FastClock(base=patient_clock()))
    with served(emulator) as (path, lines):
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


# --- DC4100 -----


# Status 0xA80: no LED at channels 2, 3 and 4, so one LED is driven.
DC4100_OPENING = [
    *[(b"N?\r\n", b"DC4100\r\n")] * 2,
    *[(b"S?\r\n", b"M00223344\r\n")] * 2,
    *[(b"V?\r\n", b"1.4.0\r\n")] * 2,
    *[(b"R?\r\n", b"2688\r\n")] * 2,
    *[(b"WL? 0\r\n", b"660.0\r\n")] * 2,
    *[(b"O? 0\r\n", b"0\r\n")] * 2,
]
# There is no checksum, so constants and what decides about light are asked twice.
LED_OFF, LED_ON = [("O? 0", "0")] * 2, [("O? 0", "1")] * 2


def dc4100_wire(pairs: list[tuple[str, str]]) -> list[tuple[bytes, bytes]]:
    return [
        *DC4100_OPENING,
        *((f"{sent}\r\n".encode(), f"{answer}\r\n".encode() if answer else b"") for sent, answer in pairs),
    ]


def opened(path: str, lines: LineRegistry) -> dc4100.Dc4100:
    return dc4100.open(dc4100.Config(port=path), lines)


@pytest.mark.parametrize(
    ("action", "pairs"),
    [
        (lambda source: source.set_light(True), [*LED_OFF, ("O 0 1", ""), *LED_ON]),
        (lambda source: source.set_light(True), LED_ON),
        (lambda source: source.set_light(False), [*LED_ON, ("O 0 0", ""), *LED_OFF]),
        (lambda source: source.is_on(), LED_ON),
        (
            lambda source: (source.select(662.0), source.set_level(40.0)),
            [*LED_OFF, *[("M?", "1")] * 2, ("BP 0 40", ""), *[("BP? 0", "40.0")] * 2],
        ),
        (
            lambda source: (source.select(662.0), source.set_level(12.5)),
            [
                *LED_OFF,
                *[("M?", "0")] * 2,
                *LED_OFF,
                ("M 1", ""),
                *[("M?", "1")] * 2,
                ("BP 0 12.5", ""),
                *[("BP? 0", "13")] * 2,
            ],
        ),
    ],
)
def test_each_call_of_a_dc4100_sends_these_lines_and_no_others(action, pairs) -> None:  # type: ignore[no-untyped-def]
    with scripted(*dc4100_wire(pairs)) as (path, lines):
        action(opened(path, lines))


# --- KURIOS -----


def test_a_kurios_has_any_wavelength_of_its_range_in_the_band_of_the_rig_file() -> None:
    emulator = KuriosEmulator(FastClock(base=patient_clock()))
    with served(emulator) as (path, lines):
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


def test_a_kurios_without_black_needs_a_shutter() -> None:
    emulator = KuriosEmulator(FastClock(base=patient_clock()))
    with served(emulator) as (path, lines):
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


def test_a_kurios_is_not_used_while_it_warms_up() -> None:
    emulator = KuriosEmulator(FastClock(base=patient_clock()))
    with served(emulator) as (path, lines):
        source = kurios.open(kurios.Config(port=path), lines)
        emulator.values["ST"] = 1
        for call in (lambda: source.select(500.0), lambda: source.set_light(True)):
            with pytest.raises(DeviceError, match="warms up"):
                call()


# --- FW102C, and one place for each wavelength -----

POSITIONS = {451.0: 1, 662.0: 3}


def test_the_filter_of_the_wavelength_stands_in_the_beam() -> None:
    emulator = FW102CEmulator(FastClock(100.0, base=patient_clock()))
    with served(emulator) as (path, lines):
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


def test_a_shutter_beside_the_wheel_makes_dark() -> None:
    emulator = FW102CEmulator(FastClock(100.0, base=patient_clock()))
    with served(emulator) as (path, lines):
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


def test_a_blocked_wheel_and_a_wrong_one_are_told() -> None:
    emulator = FW102CEmulator(FastClock(100.0, base=patient_clock()))
    with served(emulator) as (path, lines):
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


# --- I-7000: the one device that shuts the light when no program is left -----


@pytest.fixture
def module():
    emulator = I7060Emulator(FastClock(base=patient_clock()))
    with served(emulator) as (path, lines):
        yield emulator, i7000.open(i7000.Config(port=path, watchdog_s=0.5), lines)


def test_the_relay_opens_without_a_heartbeat_and_closes_again_when_asked(module):
    emulator, relay = module
    relay.set_light(True)
    for _ in range(10):
        time.sleep(0.1)
        relay.feed()
        assert relay.is_on()
    while emulator.light_at(662):
        time.sleep(0.01)
    assert not relay.is_on()
    # Dark as asked, although the module ignores the command.
    relay.set_light(False)
    relay.set_light(True)
    assert emulator.light_at(662)


def test_a_watchdog_that_runs_out_in_the_middle_is_told(module, monkeypatch):
    emulator, relay = module
    monkeypatch.setattr(relay, "feed", lambda: setattr(emulator, "_status", 0x04))
    with pytest.raises(CommandRejected, match="watchdog has run out"):
        relay.set_light(True)
