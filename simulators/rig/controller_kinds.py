"""Which controllers are emulated, and what a rig file says of one that is served."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from importlib.metadata import entry_points

import simulators.controllers
from drivers.motion import AxisConfig
from simulators.serial.emulator import Emulator
from simulators.serial.serve_options import ServeOptions


def axis_configs(emulator: Emulator, port: str, *, homed: bool = False) -> list[AxisConfig]:
    """Return a rig entry for every axis of an emulator behind `port`; none for what is not a motion controller.

    Parameters
    ----------
    homed : bool
        State it in the rig entry where the device cannot tell; for an emulator that starts with a reference.
    """
    module = importlib.import_module(type(emulator).__module__)
    configs: list[AxisConfig] = module.axis_configs(emulator, port) if hasattr(module, "axis_configs") else []
    if homed:
        configs = [
            config.model_copy(update={"assume_homed": True}) if "assume_homed" in type(config).model_fields else config
            for config in configs
        ]
    return configs


def served_kinds() -> dict[str, Callable[[ServeOptions], Emulator]]:
    """Find what can be served: the `SERVES` table of every module in `simulators/controllers/`, and of plug-ins."""
    kinds: dict[str, Callable[[ServeOptions], Emulator]] = {}
    for entry in pkgutil.iter_modules(simulators.controllers.__path__):
        module = importlib.import_module(f"simulators.controllers.{entry.name}")
        kinds.update(getattr(module, "SERVES", {}))
    for plugin in entry_points(group="umov.emulators"):
        kinds.update(plugin.load().SERVES)
    return dict(sorted(kinds.items()))
