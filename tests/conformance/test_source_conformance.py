"""What every light source must do, run against each driver and its emulator; and the source switched by hand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import CommandRejected, DeviceError, PortBusy, ReplyTimeout, WrongDevice
from drivers.serial_link import LineRegistry
from drivers.source import LightSource
from drivers.sources import dc2200, dc4100, fw102c, manual, sc10
from simulators.clock import Clock, patient_clock
from simulators.controllers.dc2200 import DC2200Emulator
from simulators.controllers.dc4100 import DC4100Emulator
from simulators.controllers.fw102c import FW102CEmulator
from simulators.controllers.sc10 import SC10Emulator
from simulators.serial.emulator import Emulator
from simulators.serial.pty_port import PtyPort
from simulators.serial.reply_faults import parse_fault


@dataclass
class Bench:
    """A source behind its emulator."""

    module: ModuleType
    emulator: Emulator
    port: PtyPort
    lines: LineRegistry

    def open(self, **options: Any) -> Any:
        needed: dict[str, Any] = {"positions": {662.0: 3}, "dark_position": 6} if self.module is fw102c else {}
        if self.module is dc2200:
            needed = {"terminals": {662.0: 1, 451.0: 2}}
        config = self.module.Config(port=self.port.path, **{"reply_s": 0.2, **needed, **options})
        source = self.module.open(config, self.lines)
        if source.selects_wavelength:
            source.select(662.0)
        return source

    def true_light(self) -> bool:
        """Whether light really comes out, which no reply tells."""
        if isinstance(self.emulator, SC10Emulator):
            return self.emulator.is_open()
        if isinstance(self.emulator, FW102CEmulator | DC2200Emulator):
            return bool(self.emulator.light_at(662.0))
        assert isinstance(self.emulator, DC4100Emulator)
        return bool(self.emulator.light())


@pytest.fixture(params=["sc10", "dc2200", "dc4100", "fw102c"])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    made: dict[str, tuple[ModuleType, Emulator]] = {
        "sc10": (sc10, SC10Emulator(Clock(base=patient_clock()))),
        "dc4100": (dc4100, DC4100Emulator(Clock(base=patient_clock()))),
        "dc2200": (dc2200, DC2200Emulator(Clock(base=patient_clock()))),
        "fw102c": (fw102c, FW102CEmulator(Clock(50.0, base=patient_clock()))),
    }
    module, emulator = made[request.param]
    port = PtyPort(emulator)
    with LineRegistry(clock=patient_clock()) as lines:
        yield Bench(module, emulator, port, lines)
    port.close()


def test_opening_and_closing_change_nothing(bench: Bench) -> None:
    source = bench.open()
    assert isinstance(source, LightSource)
    assert not bench.true_light()
    source.set_light(True)
    source.close()
    assert bench.true_light()
    again = bench.open()
    assert bench.true_light()
    assert again.is_on()


def test_light_goes_on_and_off_and_is_read_back(bench: Bench) -> None:
    source = bench.open()
    for on in (True, True, False, False, True):
        source.set_light(on)
        assert source.is_on() is on
        assert bench.true_light() is on
    assert source.interlock_open() is False


def test_it_says_what_it_is(bench: Bench) -> None:
    described = bench.open().describe()
    assert described["kind"] == bench.module.__name__.rpartition(".")[2]
    assert described["port"] == bench.port.path
    assert described["model"]


def test_a_silent_device_is_an_error_in_bounded_time(bench: Bench) -> None:
    source = bench.open()
    bench.emulator.faults.add(parse_fault("silent"))
    start_s = patient_clock().now_s()
    with pytest.raises(ReplyTimeout, match=bench.port.path):
        source.set_light(True)
    assert patient_clock().now_s() - start_s < 3


@pytest.mark.parametrize("fault", ["silent", "garbled", "foreign"])
@pytest.mark.parametrize("command", [1, 2, 3, 4])
def test_one_bad_reply_never_leads_to_a_wrong_state(bench: Bench, fault: str, command: int) -> None:
    source = bench.open()
    counted = bench.emulator.faults.commands
    bench.emulator.faults.add(parse_fault(f"{fault}@{counted + command}x1"))
    try:
        source.set_light(True)
    except DeviceError:
        return
    assert bench.true_light()


def test_another_device_on_the_port_is_named(bench: Bench) -> None:
    bench.emulator.faults.add(parse_fault("foreign"))
    with pytest.raises((WrongDevice, DeviceError), match=bench.port.path):
        bench.open()


def test_a_port_in_use_by_another_protocol_is_refused(bench: Bench) -> None:
    bench.open()

    class Other:
        def close(self) -> None: ...

    with pytest.raises(PortBusy):
        bench.lines.take(bench.port.path, Other, lambda _: Other())


def test_a_source_without_a_choice_says_so() -> None:
    class Lamp(manual.ManualSource):
        select = LightSource.select

    with pytest.raises(DeviceError, match="cannot choose"):
        Lamp(manual.Config()).select(662.0)
    with pytest.raises(DeviceError, match="no level"):
        Lamp(manual.Config()).set_level(50.0)


# --- four LEDs -------------------------------------------------------------------------------------------------


@pytest.fixture
def leds() -> Iterator[tuple[DC4100Emulator, str, LineRegistry]]:
    emulator = DC4100Emulator(Clock(base=patient_clock()), wavelengths_nm=(455.0, 530.0, 660.0, None))
    port = PtyPort(emulator)
    with LineRegistry(clock=patient_clock()) as lines:
        yield emulator, port.path, lines
    port.close()


def test_one_led_at_a_time(leds: tuple[DC4100Emulator, str, LineRegistry]) -> None:
    emulator, path, lines = leds
    source = dc4100.open(dc4100.Config(port=path), lines)
    assert source.wavelengths_nm == (455.0, 530.0, 660.0)
    with pytest.raises(DeviceError, match="no wavelength was selected"):
        source.set_light(True)
    source.select(662.0)
    assert source.set_level(40.0) == 40.0
    assert emulator.light() == {}
    source.set_light(True)
    assert emulator.light() == {660.0: 0.4}
    source.select(451.0)
    assert list(emulator.light()) == [455.0]
    source.set_light(False)
    assert emulator.light() == {}
    source.select(524.0)
    assert emulator.light() == {}


def test_channels_of_the_rig_file_win(leds: tuple[DC4100Emulator, str, LineRegistry]) -> None:
    emulator, path, lines = leds
    source = dc4100.open(dc4100.Config(port=path, channels={947.0: 1, 700.0: 4}), lines)
    source.select(947.0)
    source.set_level(100)
    source.set_light(True)
    assert emulator.light() == {455.0: 1.0}
    for missing in (700.0, 662.0):
        with pytest.raises(DeviceError, match="its LEDs are 1: 455 nm"):
            source.select(missing)
    assert emulator.light() == {455.0: 1.0}


def test_a_level_out_of_range_and_an_led_that_cannot_be_on(leds: tuple[DC4100Emulator, str, LineRegistry]) -> None:
    emulator, path, lines = leds
    source = dc4100.open(dc4100.Config(port=path), lines)
    source.select(660.0)
    with pytest.raises(CommandRejected, match="0 to 100"):
        source.set_level(120.0)
    emulator.overheat()
    with pytest.raises(CommandRejected, match="too hot"):
        source.set_light(True)


@given(data=st.binary(max_size=300))
def test_noise_at_the_emulator_switches_nothing_on_by_accident(data: bytes) -> None:
    emulator = DC4100Emulator(Clock(base=patient_clock()))
    emulator.receive(data)
    emulator.receive(b"\nE?\r\nO? 2\r\n")
    output = emulator.take_output()
    assert output.endswith(b"0\r\n") or b"o 2" in data.lower() or b"o -1" in data.lower()


# --- by hand -----------------------------------------------------------------------------------------------------


def test_the_operator_is_asked_once_for_each_change() -> None:
    questions: list[str] = []
    source = manual.ManualSource(manual.Config(), lambda question: not questions.append(question))
    for wavelength_nm in (662.0, 662.0, 451.0):
        source.select(wavelength_nm)
    for on in (True, False, False, True):
        source.set_light(on)
        assert source.is_on() is on
    assert [question.partition(".")[0] for question in questions] == [
        "Switch the source to 662 nm",
        "Switch the source to 451 nm",
        "Cover the source",
        "Uncover the source",
    ]


def test_an_operator_who_says_no_or_is_not_there_stops_it() -> None:
    for ask in (lambda _: False, None):
        source = manual.ManualSource(manual.Config(wavelengths_nm=(662.0,)), ask)
        with pytest.raises(DeviceError, match=r"said no|nobody"):
            source.select(662.0)
        with pytest.raises(DeviceError):
            source.set_light(False)
        assert source.is_on()
        with pytest.raises(DeviceError, match="lists 662 nm"):
            source.select(451.0)


def test_yes_asks_nothing() -> None:
    with LineRegistry(clock=patient_clock()) as lines:
        source = manual.open(manual.Config(), lines, yes=True)
        source.select(662.0)
        source.set_light(False)
        assert not source.is_on()
        assert source.describe()["kind"] == "manual"
