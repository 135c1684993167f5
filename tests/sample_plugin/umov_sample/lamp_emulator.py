"""The emulated lamp."""

from simulators.controllers.sc10 import SC10Emulator
from simulators.serial.serve_options import ServeOptions
from umov_sample.lamp import Config


class LampEmulator(SC10Emulator):
    """A lamp that is dark when it is switched on."""


def make(options: ServeOptions) -> LampEmulator:
    """One lamp."""
    return LampEmulator(options.clock, options.faults)


def source_configs(emulator: LampEmulator, port: str) -> list[Config]:
    """Rig entry for the lamp."""
    return [Config(port=port)]


SERVES = {"sample_lamp": make}
