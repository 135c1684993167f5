"""The emulated controllers, and the rig entry of one that is served."""

import importlib
import pkgutil
from collections.abc import Callable
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from pydantic import BaseModel

import simulators.controllers
from drivers.motion import AxisConfig
from simulators.serial.emulator import Emulator
from simulators.serial.serve_options import ServeOptions


def axis_configs(emulator: Emulator, port: str, *, homed: bool = False) -> list[AxisConfig]:
    """Return a rig entry for every axis of an emulator behind `port`; none if it is no motion controller.

    Parameters
    ----------
    homed : state it in the rig entry where the device cannot tell; for an emulator that starts with a reference.
    """
    configs: list[AxisConfig] = _entries("axis_configs", emulator, port)
    if homed:
        configs = [
            config.model_copy(update={"assume_homed": True}) if "assume_homed" in type(config).model_fields else config
            for config in configs
        ]
    return configs


def source_configs(emulator: Emulator, port: str) -> list[BaseModel]:
    """Return the rig entry for an emulated light source behind `port`; None if it is not one."""
    return _entries("source_configs", emulator, port)


def _entries(function: str, emulator: Emulator, port: str) -> list[Any]:
    module = importlib.import_module(type(emulator).__module__)
    return list(getattr(module, function)(emulator, port)) if hasattr(module, function) else []


@cache
def served_kinds() -> dict[str, Callable[[ServeOptions], Emulator]]:
    """Find what can be served: the `SERVES` table of every module in `simulators/controllers/`, and of plug-ins.

    Raises ValueError: a plug-in serves a kind that exists already.
    """
    kinds: dict[str, Callable[[ServeOptions], Emulator]] = {}
    for entry in pkgutil.iter_modules(simulators.controllers.__path__):
        module = importlib.import_module(f"simulators.controllers.{entry.name}")
        kinds.update(getattr(module, "SERVES", {}))
    for plugin in entry_points(group="umov.emulators"):
        serves = plugin.load().SERVES
        if duplicates := kinds.keys() & serves.keys():
            raise ValueError(f"plug-in {plugin.value} serves {', '.join(sorted(duplicates))}, which exists already")
        kinds.update(serves)
    return dict(sorted(kinds.items()))
