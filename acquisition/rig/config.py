"""The rig file: which devices, at which ports, which poses are forbidden, what the simulator stands in for."""

from __future__ import annotations

import importlib
import pkgutil
from functools import reduce
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from drivers.motion import AxisConfig
from processing.storage.capture_schema import Detector
from processing.yaml_file import load_yaml
from simulators.rig.model import SimulatorConfig


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def kinds(package: str) -> list[str]:
    """Names of the driver modules in a folder, for instance of "drivers.axes": each is a kind in YAML."""
    folder = importlib.import_module(package)
    return sorted(m.name for m in pkgutil.iter_modules(folder.__path__) if not m.name.startswith("_"))


def _entry(package: str) -> Any:
    # Adding a controller is one new file: its Config class joins the union by being in the folder.
    classes = [importlib.import_module(f"{package}.{kind}").Config for kind in kinds(package)]
    return Annotated[reduce(or_, classes), Field(discriminator="kind")] if len(classes) > 1 else classes[0]


if TYPE_CHECKING:
    AxisEntry = AxisConfig
    CameraEntry = Any
    SourceEntry = Any
else:
    AxisEntry = _entry("drivers.axes")
    CameraEntry = _entry("drivers.cameras")
    SourceEntry = _entry("drivers.sources")


class ModeConfig(_Part):
    """How the rig measures in one mode.

    `pose_deg`: where axes stand that do not turn in this mode, one angle or one for each wavelength.
    """

    instrument: Path
    pose_deg: dict[str, float | dict[float, float]] = {}


class ForbiddenPose(_Part):
    """A box of axis angles that the rig must neither stand in nor pass: all ranges hold at once."""

    why: str
    ranges_deg: dict[str, tuple[float, float]]


class InterlockConfig(_Part):
    """A condition under which states count.

    `door`: the source's interlock circuit is closed. `temperature`: the camera is not warmer than `limit` degrees
    Celsius. `saturation`: no more than the fraction `limit` of a state's pixels is saturated. `lamp`: a light
    state has more than the fraction `limit` of the light of the first. `drift`: a state that repeats an earlier
    pose and exposure has the same light, to the fraction `limit`.
    """

    kind: Literal["door", "temperature", "saturation", "lamp", "drift"]
    limit: float = Field(default=0.0, ge=0)


class RigConfig(_Part):
    """A rig. Relative paths are relative to the rig file."""

    kind: Literal["rig"] = "rig"
    name: str
    axes: dict[str, AxisEntry]
    camera: CameraEntry
    source: SourceEntry | None = None
    detector: Detector
    modes: dict[str, ModeConfig]
    wavelengths_nm: tuple[float, ...]
    home_at_start: bool = Field(default=False, description="home axes without a reference before the first move")
    home_order: tuple[str, ...] = ()
    park_deg: dict[str, float] = {}
    endless: tuple[str, ...] = Field(
        default=(), description="axes that may go on to the next turn instead of unwinding between captures"
    )
    backlash_deg: dict[str, Annotated[float, Field(ge=0)]] = Field(
        default={}, description="a downward move of the axis goes this far beyond its target and comes back up"
    )
    settle_s: float = Field(default=0.02, ge=0, description="wait after the last axis is idle")
    exposure_s: tuple[float, float] = Field(default=(1e-5, 10.0), description="shortest and longest exposure")
    retakes: int = Field(default=3, ge=0, description="tries again for a state whose frame is incomplete")
    wire_log: Path | None = Field(default=None, description="folder for a transcript of every byte on serial lines")
    forbidden: tuple[ForbiddenPose, ...] = ()
    interlocks: tuple[InterlockConfig, ...] = ()
    simulated: bool = Field(default=False, description="the devices at these ports are emulators (simulate rig)")
    simulator: SimulatorConfig | None = None

    @model_validator(mode="after")
    def _own_emulators_are_simulated(self) -> Self:
        # A rig with emulators of its own cannot be declared real.
        if self.simulator is not None and not self.simulated:
            object.__setattr__(self, "simulated", True)
        return self


def load_rig(path: Path | str) -> RigConfig:
    """Read a rig file; its relative paths become absolute. Raises ConfigError with file, line and key."""
    path = Path(path)
    rig = load_yaml(path, RigConfig)
    folder = path.resolve().parent
    modes = {name: mode.model_copy(update={"instrument": folder / mode.instrument}) for name, mode in rig.modes.items()}
    simulator = rig.simulator.below(folder) if rig.simulator else None
    wire_log = folder / rig.wire_log if rig.wire_log else None
    return rig.model_copy(update={"modes": modes, "simulator": simulator, "wire_log": wire_log})
