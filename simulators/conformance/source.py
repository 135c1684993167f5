"""Requirements of every light source: its light follows, is read back, and never ends in an unknown state."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import pytest
from pydantic import BaseModel

from drivers.errors import DeviceError, PortBusy, ReplyTimeout
from drivers.registry import open_source
from drivers.serial_link import LineRegistry
from drivers.source import LightSource
from simulators.clock import FastClock, patient_clock
from simulators.rig.controller_kinds import served_kinds, source_configs
from simulators.serial.emulator import Emulator
from simulators.serial.pty_port import PtyPort
from simulators.serial.reply_faults import Fault, parse_fault
from simulators.serial.serve_options import ServeOptions


@dataclass
class ServedSource:
    """A source behind its emulator, and the rig entry that opens it."""

    emulator: Emulator
    port: PtyPort
    lines: LineRegistry
    config: BaseModel
    wavelength_nm: float

    def open(self, reply_s: float = 0.2) -> LightSource:
        """Open it with a short wait for replies and choose the wavelength, where it has a choice."""
        waits = {"reply_s": reply_s} if "reply_s" in type(self.config).model_fields else {}
        source = open_source(self.config.model_copy(update=waits), self.lines)
        if source.selects_wavelength:
            source.select(self.wavelength_nm)
        return source

    def true_light(self) -> bool:
        """Whether light really comes out, which no reply tells."""
        return self.emulator.light_at(self.wavelength_nm) > 0


def source_kinds() -> list[str]:
    """Emulators of light sources, those of plug-ins too."""
    return [kind for kind, make in served_kinds().items() if source_configs(make(ServeOptions()), "none")]


class SourceConformance:
    """Tests of a light source on its emulator.

    Attributes
    ----------
    emulator : as `simulate serve` calls it: a key of the `SERVES` table of the emulator's module, which makes the rig
        entry by its function `source_configs`.
    wavelength_nm : one that the emulated source has.
    """

    emulator: ClassVar[str] = ""
    wavelength_nm: ClassVar[float] = 662.0

    @pytest.fixture
    def kind(self) -> str:
        """The emulator's name; a class for several kinds overrides this by a fixture with parameters."""
        return self.emulator

    @pytest.fixture
    def served(self, kind: str) -> Iterator[ServedSource]:
        """The emulator behind a port, dark as it is when it is switched on."""
        emulator = served_kinds()[kind](ServeOptions(clock=FastClock(50.0, base=patient_clock())))
        with PtyPort(emulator) as port, LineRegistry(clock=patient_clock()) as lines:
            (config,) = source_configs(emulator, port.path)
            yield ServedSource(emulator, port, lines, config, self.wavelength_nm)

    def test_opening_and_closing_change_nothing(self, served: ServedSource) -> None:
        source = served.open()
        assert not served.true_light()
        source.set_light(True)
        source.close()
        assert served.true_light()
        reopened = served.open()
        assert served.true_light()
        assert reopened.is_on()

    def test_light_goes_on_and_off_and_is_read_back(self, served: ServedSource) -> None:
        source = served.open()
        for on in (True, True, False, False, True):
            source.set_light(on)
            assert source.is_on() is on
            assert served.true_light() is on
        assert source.interlock_open() is False

    def test_it_says_what_it_is(self, served: ServedSource) -> None:
        described = served.open().describe()
        assert described["kind"] == served.config.kind  # type: ignore[attr-defined]
        assert described["port"] == served.port.path
        assert described["model"]

    @pytest.mark.parametrize("late_s", [0.16, 0.22])
    def test_one_late_answer_spoils_no_opening(self, served: ServedSource, late_s: float) -> None:
        """On a busy machine: one answer behind the wait for it, at every place of the opening."""
        description = served.open().describe()
        commands = served.emulator.faults.commands
        served.lines.close()
        for place in range(1, commands + 1):
            served.emulator.faults.add(Fault("late", from_command=place, commands=1, amount=late_s))
            assert served.open(reply_s=0.1).describe() == description
            served.emulator.faults.clear()
            served.lines.close()

    def test_one_answer_to_another_question_spoils_no_opening(self, served: ServedSource) -> None:
        """Whoever asked before may have closed the port before its answer came."""
        description = served.open().describe()
        commands = served.emulator.faults.commands
        served.lines.close()
        for place in range(1, commands + 1):
            served.emulator.faults.add(Fault("foreign", from_command=place, commands=1))
            assert served.open().describe() == description
            served.emulator.faults.clear()
            served.lines.close()

    def test_a_silent_device_is_an_error_in_bounded_time(self, served: ServedSource) -> None:
        source = served.open()
        served.emulator.faults.add(parse_fault("silent"))
        start_s = patient_clock().now_s()
        with pytest.raises(ReplyTimeout, match=served.port.path):
            source.set_light(True)
        assert patient_clock().now_s() - start_s < 3

    @pytest.mark.parametrize("fault", ["silent", "garbled", "foreign"])
    @pytest.mark.parametrize("command", [1, 2, 3, 4])
    def test_one_bad_reply_never_leads_to_a_wrong_state(self, served: ServedSource, fault: str, command: int) -> None:
        source = served.open()
        counted = served.emulator.faults.commands
        served.emulator.faults.add(parse_fault(f"{fault}@{counted + command}x1"))
        try:
            source.set_light(True)
        except DeviceError:
            return
        assert served.true_light()

    def test_another_device_on_the_port_is_named(self, served: ServedSource) -> None:
        served.emulator.faults.add(parse_fault("foreign"))
        with pytest.raises(DeviceError, match=served.port.path):
            served.open()

    def test_a_port_in_use_by_another_protocol_is_refused(self, served: ServedSource) -> None:
        served.open()

        class Other:
            def close(self) -> None: ...

        with pytest.raises(PortBusy):
            served.lines.take(served.port.path, Other, lambda _: Other())
