"""Opens axes and light sources. A kind of axis is a module in `drivers/axes/`, or a plug-in (entry point `umov.axes`).

A kind is a module with a `Config` model, whose field `kind` is the kind's name, and a function
``open(name, config, lines) -> MotionAxis``. The file's name is the kind.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from importlib.metadata import entry_points
from types import ModuleType
from typing import Any

import drivers.axes
from drivers.motion import AxisConfig, MotionAxis
from drivers.serial_link import LineRegistry
from drivers.source import LightSource


@cache
def axis_kinds() -> dict[str, ModuleType]:
    """Return every kind of axis with its module, in alphabetical order; a plug-in cannot replace one of ours."""
    found = {
        entry.name: importlib.import_module(f"drivers.axes.{entry.name}")
        for entry in pkgutil.iter_modules(drivers.axes.__path__)
        if not entry.name.startswith("_")
    }
    for plugin in entry_points(group="umov.axes"):
        if plugin.name in found:
            raise ValueError(f"plug-in {plugin.value} offers axis kind {plugin.name!r}, which exists already")
        found[plugin.name] = plugin.load()
    return dict(sorted(found.items()))


def open_axis(name: str, config: AxisConfig, lines: LineRegistry) -> MotionAxis:
    """Open an axis of any kind; moves nothing.

    Parameters
    ----------
    name : str
        Name of the axis in the rig, used in messages.
    config : AxisConfig
        A `Config` of one of the kinds.
    lines : LineRegistry
        Owner of the ports of this rig.

    Raises
    ------
    DeviceError
        As the port and the device have it.
    """
    kind: str = getattr(config, "kind")  # noqa: B009 - the base class has no kind, each Config has
    axis: MotionAxis = axis_kinds()[kind].open(name, config, lines)
    return axis


def open_source(config: Any, lines: LineRegistry) -> LightSource:
    """Open a light source of any kind; changes no light. Raises DeviceError."""
    source: LightSource = importlib.import_module(f"drivers.sources.{config.kind}").open(config, lines)
    return source
