"""Plans, the rig, the runner and the capture writer: everything between a YAML file and a sealed capture.

The names below are the public interface; each is imported when it is first used.

    from acquisition import DEFAULT_RIG, MeasurementPlan, load_rig, take_capture

    plan = MeasurementPlan(omega_deg=35, wavelength_nm=662)
    print(take_capture(plan, load_rig(DEFAULT_RIG), "captures"))
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from acquisition.campaign.plan import Campaign as Campaign
    from acquisition.capture.plan import MeasurementPlan as MeasurementPlan
    from acquisition.commands.defaults import CONFIGS as CONFIGS
    from acquisition.commands.defaults import DEFAULT_RIG as DEFAULT_RIG
    from acquisition.errors import AcquisitionError as AcquisitionError
    from acquisition.rig.config import RigConfig as RigConfig
    from acquisition.rig.config import load_rig as load_rig
    from acquisition.rig.open_rig import open_rig as open_rig
    from acquisition.rig.rig import Rig as Rig
    from acquisition.taking import take_capture as take_capture
    from simulators.bench.bench import SimulatedBench as SimulatedBench
    from simulators.bench.scene import Scene as Scene
    from simulators.bench.virtual_capture import write_virtual_capture as write_virtual_capture

_PUBLIC = {
    "MeasurementPlan": "acquisition.capture.plan",
    "Campaign": "acquisition.campaign.plan",
    "RigConfig": "acquisition.rig.config",
    "Rig": "acquisition.rig.rig",
    "open_rig": "acquisition.rig.open_rig",
    "load_rig": "acquisition.rig.config",
    "take_capture": "acquisition.taking",
    "CONFIGS": "acquisition.commands.defaults",
    "DEFAULT_RIG": "acquisition.commands.defaults",
    "AcquisitionError": "acquisition.errors",
    "SimulatedBench": "simulators.bench.bench",
    "Scene": "simulators.bench.scene",
    "write_virtual_capture": "simulators.bench.virtual_capture",
}

__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'acquisition' has no public name {name!r}; it has: {', '.join(sorted(_PUBLIC))}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return __all__
