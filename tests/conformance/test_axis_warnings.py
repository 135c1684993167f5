"""Warnings are told from faults, and models that are not known but compatible are accepted with a word."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from drivers.errors import MotionFailed, WrongDevice
from drivers.motion import MotionAxis
from drivers.registry import open_axis
from drivers.serial_link import LineRegistry
from simulators.clock import FastClock, patient_clock
from simulators.rig.controller_kinds import axis_configs, served_kinds
from simulators.serial.emulator import Emulator
from simulators.serial.serve_options import ServeOptions
from simulators.serial.tcp_port import port_for


@contextmanager
def opened(kind: str, model: str | None = None, **changes: object) -> Iterator[tuple[Emulator, MotionAxis]]:
    emulator = served_kinds()[kind](ServeOptions(homed=True, model=model, clock=FastClock(100.0, base=patient_clock())))
    with port_for(emulator) as port, LineRegistry(clock=patient_clock()) as lines:
        config = axis_configs(emulator, port.path, homed=True)[0].model_copy(update=changes)
        yield emulator, open_axis("axis", config, lines)


def test_a_warning_flag_does_not_end_a_move_and_a_fault_does() -> None:
    with opened("zaber") as (emulator, axis):
        assert axis.warnings() == []
        emulator.devices[0].extra_flags = ["WT"]  # type: ignore[attr-defined]
        assert axis.start_move(20.0).wait().deg == pytest.approx(20.0, abs=0.01)
        assert axis.warnings() == ["WT temperature high"]
        emulator.devices[0].extra_flags = ["FS", "WT"]  # type: ignore[attr-defined]
        with pytest.raises(MotionFailed, match="FS stalled and stopped"):
            axis.start_move(30.0).wait()


def test_a_note_about_an_interrupted_move_is_only_a_note() -> None:
    with opened("zaber") as (_, axis):
        axis.start_move(3000.0)
        axis.stop()
        while axis.is_moving():
            pass
        assert axis.warnings() == ["NI movement interrupted"]
        assert axis.start_move(1.0).wait().deg == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("kind", "model", "word"),
    [
        ("apt-k10cr1", "K10CR3", "treated as K10CR1"),
        ("elliptec", "ELL22", "treated as ELL14"),
        ("smc100", "FCL", "SMC100"),
    ],
)
def test_an_unknown_but_compatible_model_warns(kind: str, model: str, word: str) -> None:
    with opened(kind, model) as (_, axis):
        assert any(word in warning for warning in axis.warnings())
        assert axis.start_move(12.0).wait().deg == pytest.approx(12.0, abs=0.05)


def test_known_models_do_not_warn() -> None:
    for kind in ("apt-k10cr1", "apt-k10cr2", "apt-kdc101", "elliptec", "smc100", "zaber"):
        with opened(kind) as (_, axis):
            assert axis.warnings() == []


def test_a_controller_with_an_unknown_stage_needs_the_scale_from_the_rig_file() -> None:
    with pytest.raises(WrongDevice, match="counts per degree"), opened("apt-kdc101", "XYZ101"):
        pass
    with opened("apt-kdc101", "XYZ101", stage="PRM1-Z8") as (_, axis):
        assert axis.counts_per_deg == pytest.approx(1919.64, abs=0.01)


def test_a_linear_elliptec_stage_is_refused() -> None:
    with pytest.raises(WrongDevice, match="linear"), opened("elliptec", "ELL17"):
        pass


def test_homing_with_a_speed_of_zero_is_refused_and_can_be_set() -> None:
    from drivers.errors import CommandRejected

    with opened("apt-k10cr1") as (emulator, axis):
        emulator.units[0].home_parameters[2] = 0  # type: ignore[attr-defined]
        with pytest.raises(CommandRejected, match="stand still"):
            axis.home()
    with opened("apt-k10cr1", home_speed_deg_s=90.0) as (emulator, axis):
        emulator.units[0].home_parameters[2] = 0  # type: ignore[attr-defined]
        axis.home().wait()
        assert axis.is_homed()
