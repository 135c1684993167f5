"""The emulated stage: what `simulate serve sample_stage` serves and the conformance tests drive."""

from drivers.motion import AxisConfig
from simulators.controllers import zaber
from simulators.serial.serve_options import ServeOptions
from umov_sample.stage import Config


class StageEmulator(zaber.ZaberEmulator):
    """A chain of stages."""


def make(options: ServeOptions) -> StageEmulator:
    """As many stages as asked for, without a reference."""
    return StageEmulator(zaber.make(options).devices, options.clock, options.faults)


def axis_configs(emulator: StageEmulator, port: str) -> list[AxisConfig]:
    """Rig entries for every stage of the chain."""
    return [Config(port=port, serial_number=device.serial_number) for device in emulator.devices]


SERVES = {"sample_stage": make}
