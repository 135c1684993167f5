"""The sections of a rig file, each readable for itself; what they say about one another is `soundness`."""

from __future__ import annotations

from functools import reduce
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from acquisition.rig.parts import ForbiddenPose, HomingPath, InterlockConfig, ModeConfig, Range
from acquisition.rig.solids import Solids
from acquisition.screen.notify import NotifyConfig
from drivers.motion import AxisConfig
from drivers.registry import Family, device_kinds
from processing.section import FiniteSection
from processing.storage.captures.schema import Detector
from simulators.rig.model import SimulatorConfig


def _entry(family: Family) -> Any:
    # Adding a controller is one new file: its Config class joins the union by being in the folder, or a plug-in.
    classes = [module.Config for module in device_kinds(family).values()]
    return Annotated[reduce(or_, classes), Field(discriminator="kind")] if len(classes) > 1 else classes[0]


if TYPE_CHECKING:
    AxisEntry = AxisConfig
    CameraEntry = Any
    SourceEntry = Any
else:
    AxisEntry = _entry("axes")
    CameraEntry = _entry("cameras")
    SourceEntry = _entry("sources")


class RigSections(FiniteSection):
    """A rig. Relative paths are relative to the rig file."""

    kind: Literal["rig"] = "rig"
    name: str = Field(min_length=1, description="name that messages and other files use")
    axes: dict[str, AxisEntry] = Field(description="axes by name: controller, address, zero, direction")
    camera: CameraEntry = Field(description="camera and how it is set")
    source: SourceEntry | None = Field(
        default=None, description="light source or shutter; without one, darks are asked for"
    )
    cutoff: SourceEntry | None = Field(
        default=None,
        description="second shutter or relay in the light, best one that shuts by itself without a heartbeat; the "
        "guard of `acquire` holds it, and light passes it only while the guard watches",
    )
    detector: Detector = Field(description="constants of the detector's noise, for error bars")
    modes: dict[str, ModeConfig] = Field(
        min_length=1, description="measuring modes: instrument model and pose of what does not turn"
    )
    wavelengths_nm: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        min_length=1, description="wavelengths that the rig can give, nm"
    )
    home_at_start: bool = Field(default=False, description="home axes without a reference before the first move")
    home_order: tuple[str, ...] = Field(default=(), description="order of homing; the arm first and alone")
    homing: dict[str, HomingPath] = Field(default={}, description="what an axis may pass while it homes; default all")
    park_deg: dict[str, float] = Field(default={}, description="where a run that is stopped leaves axes")
    endless: tuple[str, ...] = Field(
        default=(), description="axes that may go on to the next turn instead of unwinding between captures"
    )
    fold_deg: dict[str, Literal[180, 360]] = Field(
        default={},
        description="targets outside the travel of these axes are moved into it by whole multiples; 180 for polarizers "
        "and retarders, which look the same after half a turn but for a wedge",
    )
    backlash_deg: dict[str, Annotated[float, Field(ge=0, le=90)]] = Field(
        default={}, description="a downward move of the axis goes this far beyond its target and comes back up"
    )
    settle_s: float = Field(default=0.02, ge=0, le=600, description="wait after the last axis is idle")
    exposure_s: Range = Field(default=(1e-5, 10.0), description="shortest and longest exposure")
    retakes: int = Field(default=3, ge=0, le=1000, description="tries again for a state whose frame is incomplete")
    alert: tuple[str, ...] = Field(
        default=(), description="command that is run, with a message as its last argument, when a run fails or dies"
    )
    alert_every_s: float = Field(default=60.0, ge=1, description="time between two alerts of an alarm")
    notify: NotifyConfig | None = Field(default=None, description="who hears of an end, a failure, an interlock")
    wire_log: Path | None = Field(default=None, description="folder for a transcript of every byte on serial lines")
    forbidden: tuple[ForbiddenPose, ...] = Field(default=(), description="poses that no move may pass")
    solids: Solids | None = Field(default=None, description="arm, sample holder, ... that must keep apart")
    interlocks: tuple[InterlockConfig, ...] = Field(default=(), description="what ends or holds a run")
    simulated: bool = Field(default=False, description="the devices at these ports are emulators (simulate rig)")
    simulator: SimulatorConfig | None = Field(
        default=None, description="emulators that stand in for the devices at ports sim:NAME"
    )
