"""What every light source must do, run against each driver and its emulator; and the source switched by hand."""

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import CommandRejected, DeviceError
from drivers.registry import device_kinds
from drivers.serial_link import LineRegistry
from drivers.source import LightSource
from drivers.sources import dc4100, manual
from simulators.clock import FastClock, patient_clock
from simulators.conformance import SourceConformance
from simulators.conformance.source import source_kinds
from simulators.controllers.dc4100 import DC4100Emulator
from simulators.rig.controller_kinds import served_kinds, source_configs
from simulators.serial.pty_port import PtyPort
from simulators.serial.serve_options import ServeOptions


class TestEverySource(SourceConformance):
    @pytest.fixture(params=source_kinds())
    def kind(self, request: pytest.FixtureRequest) -> str:
        return str(request.param)


def test_every_kind_of_source_with_a_cable_has_an_emulator() -> None:
    covered = {
        config.kind  # type: ignore[attr-defined]
        for kind in source_kinds()
        for config in source_configs(served_kinds()[kind](ServeOptions()), "none")
    }
    assert covered == set(device_kinds("sources")) - {"manual"}


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
    emulator = DC4100Emulator(FastClock(base=patient_clock()), wavelengths_nm=(455.0, 530.0, 660.0, None))
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
    emulator = DC4100Emulator(FastClock(base=patient_clock()))
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
