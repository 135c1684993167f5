"""A lamp of another maker behind a shutter with SC10's commands."""

from typing import Literal

from drivers.serial_link import LineRegistry
from drivers.source import LightSource
from drivers.sources import sc10


class Config(sc10.Config):
    """The lamp in a rig file."""

    kind: Literal["sample_lamp"] = "sample_lamp"


def open(config: Config, lines: LineRegistry) -> LightSource:
    """Open the lamp; its light stays as it is."""
    return sc10.open(config, lines)
