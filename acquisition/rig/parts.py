"""The sections of a rig file besides its devices."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from processing.section import FiniteSection


def _ascending(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError(f"the range {ends[0]:g} to {ends[1]:g} is high first: nothing lies in it. Swap its ends")
    return ends


#: Lowest and highest value, in this order.
Range = Annotated[tuple[float, float], AfterValidator(_ascending)]


class ModeConfig(FiniteSection):
    """How the rig measures in one mode.

    `pose_deg`: where axes stand that do not turn in this mode, one angle or one for each wavelength.
    """

    instrument: Path = Field(description="instrument file, relative to the rig file")
    pose_deg: dict[str, float | dict[float, float]] = Field(
        default={}, description="where axes stand that the states do not turn, degrees"
    )


class ForbiddenPose(FiniteSection):
    """A box of axis angles that the rig must neither stand in nor pass: all ranges hold at once."""

    why: str = Field(description="what would happen, for the message")
    ranges_deg: Annotated[dict[str, Range], Field(min_length=1)] = Field(
        description="range of each axis, degrees; the pose is forbidden where all are met"
    )
    homing_may_pass: bool = Field(
        default=False, description="nothing is hit there; it is only no pose to measure in, so homing may pass it"
    )


class HomingPath(FiniteSection):
    """What an axis may pass while it homes, from wherever it was left, and where it stands afterwards."""

    passes_deg: Range = Field(description="range that homing passes, degrees")
    ends_deg: float = Field(description="where homing ends, degrees")

    @model_validator(mode="after")
    def _ends_inside(self) -> Self:
        low, high = self.passes_deg
        if not low <= self.ends_deg <= high:
            raise ValueError(f"ends_deg {self.ends_deg:g} lies outside passes_deg {low:g} to {high:g}")
        return self


class InterlockConfig(FiniteSection):
    """A condition under which states count.

    `door`: the source's interlock circuit is closed. `temperature`: the camera is not warmer than `limit` degrees
    Celsius. `saturation`: no more than the fraction `limit` of a state's pixels is saturated. `lamp`: a light
    state has more than the fraction `limit` of the light of the first. `drift`: a state that repeats an earlier
    pose and exposure has the same light, to the fraction `limit`.
    """

    kind: Literal["door", "temperature", "saturation", "lamp", "drift"] = Field(
        description="door, temperature, saturation, lamp or drift"
    )
    limit: float = Field(default=0.0, ge=0, description="degC for temperature, else a fraction")
