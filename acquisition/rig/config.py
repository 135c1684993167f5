"""The rig file: which devices, at which ports, which poses are forbidden, what the simulator stands in for."""

from __future__ import annotations

import contextlib
import importlib
import pkgutil
from functools import reduce
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, ModelWrapValidatorHandler, TypeAdapter, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from acquisition.rig.parts import ForbiddenPose, HomingPath, InterlockConfig, ModeConfig, Part, Range
from acquisition.rig.solids import Solids
from acquisition.rig.soundness import Mistake, find_mistakes
from drivers.motion import AxisConfig
from processing.storage.capture_schema import Detector
from processing.yaml_file import load_yaml, message_of
from simulators.rig.model import SimulatorConfig


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


class RigConfig(Part):
    """A rig. Relative paths are relative to the rig file."""

    kind: Literal["rig"] = "rig"
    name: str
    axes: dict[str, AxisEntry]
    camera: CameraEntry
    source: SourceEntry | None = None
    detector: Detector
    modes: dict[str, ModeConfig]
    wavelengths_nm: tuple[Annotated[float, Field(gt=0)], ...]
    home_at_start: bool = Field(default=False, description="home axes without a reference before the first move")
    home_order: tuple[str, ...] = ()
    homing: dict[str, HomingPath] = Field(default={}, description="what an axis may pass while it homes; default all")
    park_deg: dict[str, float] = Field(default={}, description="where a run that is stopped leaves axes")
    endless: tuple[str, ...] = Field(
        default=(), description="axes that may go on to the next turn instead of unwinding between captures"
    )
    backlash_deg: dict[str, Annotated[float, Field(ge=0, le=90)]] = Field(
        default={}, description="a downward move of the axis goes this far beyond its target and comes back up"
    )
    settle_s: float = Field(default=0.02, ge=0, le=600, description="wait after the last axis is idle")
    exposure_s: Range = Field(default=(1e-5, 10.0), description="shortest and longest exposure")
    retakes: int = Field(default=3, ge=0, le=1000, description="tries again for a state whose frame is incomplete")
    wire_log: Path | None = Field(default=None, description="folder for a transcript of every byte on serial lines")
    forbidden: tuple[ForbiddenPose, ...] = ()
    solids: Solids | None = Field(default=None, description="arm, sample holder, ... that must keep apart")
    interlocks: tuple[InterlockConfig, ...] = ()
    simulated: bool = Field(default=False, description="the devices at these ports are emulators (simulate rig)")
    simulator: SimulatorConfig | None = None

    @model_validator(mode="wrap")
    @classmethod
    def _all_mistakes_at_once(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        # What one section says about another is looked at even where a section cannot be read at all.
        wrong: list[Mistake] = []
        rig: RigConfig
        try:
            rig = valid = handler(data)
        except ValidationError as error:
            if not isinstance(data, dict):
                raise
            rig, valid = _readable(data), None
            wrong = [(entry["loc"], message_of(entry)) for entry in error.errors()]
        wrong += find_mistakes(rig)
        if valid is None or wrong:
            raise ValidationError.from_exception_data(cls.__name__, [_details(where, why) for where, why in wrong])
        return valid

    @model_validator(mode="after")
    def _own_emulators_are_simulated(self) -> Self:
        # A rig with emulators of its own cannot be declared real.
        if self.simulator is not None and not self.simulated:
            object.__setattr__(self, "simulated", True)
        return self


def _readable(data: dict[str, Any]) -> RigConfig:
    """The sections of a rig file that can be read for themselves; the others have their defaults."""
    sections: dict[str, Any] = {"modes": {}, "wavelengths_nm": ()}
    for name, field in RigConfig.model_fields.items():
        with contextlib.suppress(ValidationError):
            if name in data and name != "axes":
                sections[name] = TypeAdapter[Any](field.annotation).validate_python(data[name])  # type: ignore[arg-type]
    axes = data.get("axes")
    sections["axes"] = {}
    for name, entry in axes.items() if isinstance(axes, dict) else ():
        try:
            sections["axes"][name] = TypeAdapter(AxisEntry).validate_python(entry)
        except ValidationError:
            # Its name is known all the same.
            sections["axes"][name] = None
    return RigConfig.model_construct(**sections)


def _details(where: tuple[int | str, ...], why: str) -> InitErrorDetails:
    return InitErrorDetails(type=PydanticCustomError("rig", "{why}", {"why": why}), loc=where, input=None)


def load_rig(path: Path | str) -> RigConfig:
    """Read a rig file; its relative paths become absolute. Raises ConfigError with file, line and key."""
    path = Path(path)
    rig = load_yaml(path, RigConfig)
    folder = path.resolve().parent
    modes = {name: mode.model_copy(update={"instrument": folder / mode.instrument}) for name, mode in rig.modes.items()}
    simulator = rig.simulator.below(folder) if rig.simulator else None
    wire_log = folder / rig.wire_log if rig.wire_log else None
    return rig.model_copy(update={"modes": modes, "simulator": simulator, "wire_log": wire_log})
