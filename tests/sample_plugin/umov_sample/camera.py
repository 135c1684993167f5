"""A camera of another maker behind GenICam."""

from typing import Literal

from drivers.camera import Camera
from drivers.cameras import aravis
from drivers.clock import Clock


class Config(aravis.Config):
    """The camera in a rig file."""

    kind: Literal["sample_camera"] = "sample_camera"


def open(name: str, config: Config, clock: Clock) -> Camera:
    """Open the camera; takes no frame."""
    return aravis.open(name, config, clock)
