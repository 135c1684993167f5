"""A rotary stage of another maker that speaks Zaber's protocol."""

from typing import Literal

from drivers.axes import zaber
from drivers.motion import MotionAxis
from drivers.serial_link import LineRegistry


class Config(zaber.Config):
    """The stage in a rig file."""

    kind: Literal["sample_stage"] = "sample_stage"


def open(name: str, config: Config, lines: LineRegistry) -> MotionAxis:
    """Open the stage; moves nothing."""
    return zaber.open(name, config, lines)
