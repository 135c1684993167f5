"""A measurement plan: one capture as a value, read from YAML, iterated into states."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag, ValidationError, model_validator

from processing.instrument.states import (
    RGB950_RATIO,
    RGB950_STATES,
    RGB950_STEP_DEG,
    Role,
    StateTable,
    rotating_retarders,
)
from processing.section import FiniteSection
from processing.storage.captures.schema import Sample
from processing.yaml_file import ConfigError, load_yaml
from processing.yaml_words import NAME_PATTERN, mistakes_of, words_of

#: Name of a mode of the rig file; file names of captures hold it.
Mode = Annotated[str, Field(pattern=NAME_PATTERN)]

#: For each axis its positions by their names.
NamedStates: TypeAlias = Mapping[str, Mapping[str, float]]

#: The axis that sets Omega, where the rig has one.
ARM = "arm"


class RotatingRetarders(FiniteSection):
    """Equal steps of the generator retarder; the analyzer retarder turns `ratio` times as far.

    `axes` names the generator's axis and the analyzer's.
    """

    kind: Literal["rotating_retarders"] = "rotating_retarders"
    states: int = Field(default=RGB950_STATES, gt=0, le=10_000, description="number of poses")
    step_deg: float = Field(
        default=RGB950_STEP_DEG, ge=-360, le=360, description="step of the generator's plate, degrees"
    )
    ratio: float = Field(
        default=RGB950_RATIO, ge=-1000, le=1000, description="how many times as far the analyzer's plate turns"
    )
    axes: tuple[str, str] = Field(
        default=("psg", "psa"), description="names of the generator's and the analyzer's axis"
    )

    def angles_deg(self, named: NamedStates) -> dict[str, NDArray[np.float64]]:
        """Target angles of each axis (states,), degrees."""
        return dict(rotating_retarders(1.0, self.states, self.step_deg, self.ratio, axes=self.axes).angles_deg)


class FixedPose(FiniteSection):
    """Every frame in the same pose, the one that the rig file gives for the mode."""

    kind: Literal["fixed"] = "fixed"
    states: int = Field(default=8, gt=0, le=10_000, description="number of frames in the one pose")

    def angles_deg(self, named: NamedStates) -> dict[str, NDArray[np.float64]]:
        """This mode turns no axis."""
        return {}


class ListedStates(FiniteSection):
    """Any table: a list of angles for each axis, all of one length; of a liquid crystal volts, or names of states."""

    kind: Literal["table"]
    angles: dict[str, tuple[Annotated[float, Field(allow_inf_nan=False)] | str, ...]] = Field(
        description="for each axis its angle in each pose, degrees; for a liquid crystal volts, or names of its "
        "`states` in the rig file; all lists of one length"
    )

    @model_validator(mode="after")
    def _one_length(self) -> Self:
        lengths = {name: len(column) for name, column in self.angles.items()}
        if len(set(lengths.values())) != 1 or 0 in lengths.values():
            raise ValueError(f"every axis needs the same number of angles, at least one; got {lengths}")
        return self

    @property
    def states(self) -> int:
        """Number of states."""
        return len(next(iter(self.angles.values())))

    def angles_deg(self, named: NamedStates) -> dict[str, NDArray[np.float64]]:
        """Target angles of each axis (states,), degrees or volts. Raises ConfigError for a name that is not there."""

        def number(axis: str, target: float | str) -> float:
            states = named.get(axis, {})
            if isinstance(target, str) and target not in states:
                raise ConfigError(f"axis {axis} has no state {target!r}, only: {', '.join(states) or 'none'}")
            return states[target] if isinstance(target, str) else target

        return {axis: np.array([number(axis, target) for target in column]) for axis, column in self.angles.items()}


States = Annotated[RotatingRetarders | FixedPose | ListedStates, Field(discriminator="kind")]


class AutoExposure(FiniteSection):
    """Exposure found before the capture: the brightest states are probed first.

    The `percentile` of the pixels of the brightest state comes to `target` of full scale; no state saturates.
    """

    kind: Literal["auto"] = "auto"
    percentile: float = Field(default=99.9, gt=0, le=100, description="of the pixels of the brightest state")
    target: float = Field(default=0.7, gt=0, lt=1, description="part of full scale that this percentile comes to")
    start_s: float = Field(default=0.005, gt=0, description="exposure that the search begins with, s")
    longest_s: float = Field(default=10.0, gt=0, description="longest exposure that the search may choose, s")


def exposure_kind(value: Any) -> str:
    """Which kind of exposure is meant, so that an error speaks of that one alone."""
    if isinstance(value, AutoExposure) or (isinstance(value, dict) and "kind" in value):
        return "auto"
    return "by wavelength" if isinstance(value, dict) else "seconds"


Seconds = Annotated[float, Tag("seconds")]
Auto = Annotated[AutoExposure, Tag("auto")]


class MeasurementPlan(FiniteSection):
    """One capture.

    Darks come first: the shutter is closed, the axes stand in the pose of the first state. `repeats` frames are
    averaged for each state. `bracket` lists factors on the exposure, for instance (1, 8): every pose is taken with
    each, darks too, as states of their own; the reduction uses of each pixel what is not saturated.

    Examples
    --------
    >>> from acquisition import MeasurementPlan
    >>> plan = MeasurementPlan(omega_deg=35, wavelength_nm=662)
    >>> plan.mode, plan.exposure_s, plan.darks
    ('drr', 0.02, 4)
    """

    kind: Literal["plan"] = "plan"
    title: str = Field(
        default="", description="title of the capture; made of sample, mode, wavelength and angle without it"
    )
    mode: Mode = Field(default="drr", description="mode of the rig file: which instrument and which pose")
    wavelength_nm: float = Field(default=662, gt=0, description="nm, one of the rig's")
    omega_deg: float = Field(default=35, allow_inf_nan=False, description="angle between source and camera, degrees")
    sample: Sample = Field(default=Sample(name="red_sphere"), description="what stands at the centre")
    illumination: Literal["horizontal", "vertical"] = Field(
        default="horizontal", description="word for the light, kept with the capture"
    )
    states: States = Field(default=RotatingRetarders(), description="the poses of the polarimeter")
    exposure_s: Annotated[Seconds | Auto, Discriminator(exposure_kind)] = Field(
        default=0.02, description="seconds of one frame, or {kind: auto}"
    )
    repeats: int = Field(default=1, ge=1, le=1000, description="frames averaged into each state")
    darks: int = Field(default=4, ge=0, le=1000, description="states with the shutter closed, first, at each exposure")
    repeat_first: bool = Field(default=False, description="take the first light state again at the end: a drift check")
    bracket: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        default=(1.0,), min_length=1, description="factors of the exposure at which every pose is taken, such as [1, 8]"
    )
    role: Literal["flat", "air", "sample"] | None = Field(
        default=None, description="of the light states; default air for the sample air, else sample"
    )
    continue_after_interlock: bool = Field(
        default=False, description="go on by itself when an interlock closes again, if its reason is one that passes"
    )

    @model_validator(mode="after")
    def _exposure_is_positive(self) -> Self:
        if isinstance(self.exposure_s, float) and not (0 < self.exposure_s < float("inf")):
            raise ValueError(f"exposure_s must be a positive number of seconds, got {self.exposure_s:g}")
        return self

    @classmethod
    def load(cls, path: Path | str) -> "MeasurementPlan":
        """Read a plan file. Raises ConfigError with file, line and key."""
        return load_yaml(path, cls)

    def with_changes(self, **changes: Any) -> "MeasurementPlan":
        """A copy with the values that are not None, validated again. Raises ConfigError."""
        values = {name: value for name, value in changes.items() if value is not None}
        try:
            return MeasurementPlan.model_validate(self.model_dump() | values)
        except ValidationError as error:
            lines = [": ".join(filter(None, (".".join(map(str, e["loc"])), words_of(e)))) for e in mistakes_of(error)]
            raise ConfigError("\n".join(lines)) from error

    def state_table(
        self, pose_deg: Mapping[str, float], exposure_s: float, named: NamedStates | None = None
    ) -> StateTable:
        """Rows of the capture: darks in the first pose, then the sample states.

        Parameters
        ----------
        pose_deg
            Angle of every axis that stands still during the capture (the arm, a Stokes pose).
        exposure_s
            Exposure of every state in seconds, times the factors of the bracket.
        named
            Positions by their names, for each axis that has names.
        """
        turning = self.states.angles_deg(named or {})
        if self.repeat_first:
            turning = {name: np.append(column, column[0]) for name, column in turning.items()}
        n, factors = self.states.states + self.repeat_first, len(self.bracket)
        darks = self.darks * factors
        columns = {name: np.full(n, float(angle)) for name, angle in pose_deg.items() if name not in turning} | turning
        columns = {name: np.repeat(column, factors) for name, column in columns.items()}
        dark: Role = "dark"
        light: Role = self.role or ("air" if self.sample.kind == "air" else "sample")
        role = (dark,) * darks + (light,) * (n * factors)
        exposures = exposure_s * np.tile(self.bracket, self.darks + n)
        return StateTable(
            angles_deg={k: np.concatenate([np.full(darks, column[0]), column]) for k, column in columns.items()},
            exposure_s=exposures,
            role=role,
            repeats=np.full(len(role), self.repeats, dtype=np.int64),
        )
