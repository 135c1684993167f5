"""Emulated axes for the conformance tests: a fast clock, short waits, one port each."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import pytest

from drivers.motion import AxisConfig, MotionAxis
from drivers.registry import open_axis
from drivers.serial_link import LineRegistry
from simulators.clock import FastClock, patient_clock
from simulators.rig.controller_kinds import axis_configs, served_kinds
from simulators.serial.emulator import Emulator
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions
from simulators.serial.served_port import ServedPort
from simulators.serial.tcp_port import port_for

WIDE = (-1000.0, 1000.0)
FAST = 200.0


@dataclass
class ServedAxes:
    """An emulator behind a port, and the rig entries that open it."""

    emulator: Emulator
    port: ServedPort
    lines: LineRegistry
    configs: list[AxisConfig]

    def open(self, index: int = 0, **changes: object) -> MotionAxis:
        """Open an axis with short waits, as the emulator is fast."""
        config = self.configs[index]
        short = {"poll_s": 0.002, "margin_s": 0.3, "stall_s": 0.3, "reply_s": 0.25, "pause_before_move_s": 0.0}
        waits = {name: value for name, value in short.items() if name in type(config).model_fields}
        entry = type(config).model_validate(config.model_dump() | waits | changes)
        return open_axis(f"axis{index}", entry, self.lines)


class AxisTests:
    """Base of the conformance classes of an axis: the name under which its emulator is served.

    Attributes
    ----------
    emulator : as `simulate serve` calls it: a key of the `SERVES` table of the emulator's module.
    """

    emulator: ClassVar[str] = ""

    @pytest.fixture
    def kind(self) -> str:
        """The emulator's name; a class for several kinds overrides this by a fixture with parameters."""
        return self.emulator

    @contextlib.contextmanager
    def served(self, kind: str, homed: bool = True, speed: float = FAST, **options: object) -> Iterator[ServedAxes]:
        """Serve one kind, homed so that a test need not wait for homing; overridden where the axis has no wire."""
        options = {"limits_deg": WIDE, "faults": FaultSchedule(seed=7)} | options
        clock = FastClock(speed, base=patient_clock())
        emulator = served_kinds()[kind](ServeOptions(homed=homed, clock=clock, **options))  # type: ignore[arg-type]
        with port_for(emulator) as port, LineRegistry(clock=patient_clock()) as lines:
            yield ServedAxes(emulator, port, lines, axis_configs(emulator, port.path, homed=homed))


def motion_kinds(axes: int = 1) -> list[str]:
    """Emulators of controllers whose axes turn, those of plug-ins too, that can serve so many axes."""
    kinds = []
    for kind, make in served_kinds().items():
        # A controller of one axis refuses to be made with more.
        with contextlib.suppress(ValueError):
            configs = axis_configs(make(ServeOptions(axes=axes)), "none")
            if len(configs) == axes and all(config.unit == "deg" for config in configs):
                kinds.append(kind)
    return kinds


def serial_kinds() -> list[str]:
    """Those behind a serial port: a controller on the network takes several programs at once."""
    return [kind for kind in motion_kinds() if not hasattr(served_kinds()[kind](ServeOptions()), "connect")]
