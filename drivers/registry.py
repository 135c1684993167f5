"""Finds and opens devices by kind: a module in `drivers/axes`, `cameras` or `sources`, or a plug-in of that group.

A kind is a module with a `Config` model, whose field `kind` is the kind's name, and a function `open`:
``open(name, config, lines) -> MotionAxis``, ``open(name, config, clock) -> Camera`` or
``open(config, lines) -> LightSource``. The file's name is the kind. An outside package announces such a module by the
entry point `umov.axes`, `umov.cameras` or `umov.sources`, under the kind's name.
"""

import importlib
import pkgutil
from functools import cache
from importlib.metadata import entry_points
from types import ModuleType
from typing import Any, Literal

from drivers.camera import Camera
from drivers.clock import Clock
from drivers.motion import AxisConfig, MotionAxis
from drivers.serial_link import LineRegistry
from drivers.source import LightSource

Family = Literal["axes", "cameras", "sources"]


@cache
def device_kinds(family: Family) -> dict[str, ModuleType]:
    """Return every kind of a family with its module, in alphabetical order.

    Raises ValueError: a plug-in offers a kind that exists already, or a module that is none.
    """
    folder = importlib.import_module(f"drivers.{family}")
    kinds = {
        entry.name: importlib.import_module(f"drivers.{family}.{entry.name}")
        for entry in pkgutil.iter_modules(folder.__path__)
        if not entry.name.startswith("_")
    }
    for plugin in _plug_ins().select(group=f"umov.{family}"):
        if plugin.name in kinds:
            raise ValueError(
                f"plug-in {plugin.value} offers the kind {plugin.name!r} of {family}, which exists already"
            )
        module = plugin.load()
        if not (hasattr(module, "Config") and hasattr(module, "open")):
            raise ValueError(f"plug-in {plugin.value} for {family} needs a `Config` and a function `open`")
        kinds[plugin.name] = module
    return dict(sorted(kinds.items()))


@cache
def _plug_ins() -> Any:
    # Of all groups: each question reads the records of every installed package.
    return entry_points()


def open_axis(name: str, config: AxisConfig, lines: LineRegistry) -> MotionAxis:
    """Open an axis of any kind; moves nothing.

    Parameters
    ----------
    name : name of the axis in the rig, used in messages.
    config : a `Config` of one of the kinds.
    lines : owner of the ports of this rig.

    Raises
    ------
    DeviceError
        As the port and the device have it.
    """
    kind: str = getattr(config, "kind")  # noqa: B009 - the base class has no kind, each Config has
    axis: MotionAxis = device_kinds("axes")[kind].open(name, config, lines)
    return axis


def open_camera(name: str, config: Any, clock: Clock) -> Camera:
    """Open a camera of any kind; takes no frame. Raises DeviceError."""
    camera: Camera = device_kinds("cameras")[config.kind].open(name, config, clock)
    return camera


def open_source(config: Any, lines: LineRegistry) -> LightSource:
    """Open a light source of any kind; changes no light. Raises DeviceError."""
    source: LightSource = device_kinds("sources")[config.kind].open(config, lines)
    return source
