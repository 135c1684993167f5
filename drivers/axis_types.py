"""Identity, position and limits of an axis, and its entry in a rig file."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

# Controllers that tell a limit of every stage tell one as large as this where there is none.
NO_LIMIT_DEG = 1e6
# Sums of zero and angle in floating point: a target at the limit itself is inside.
ROUNDING_DEG = 1e-6


@dataclass(frozen=True, slots=True)
class Position:
    """A position read from an axis: user degrees (volts where `unit` says so), and the controller's own number.

    A position at rest is confirmed by a second reading; one in motion (`confirmed` False) cannot be, and is for
    show and for the detection of a stall, not for a record.
    """

    deg: float
    counts: int | float
    confirmed: bool = True
    unit: str = "deg"

    def __str__(self) -> str:
        """For a page: what turns on and on is within one turn."""
        return f"{self.deg % 360:.3f}°" if self.unit == "deg" else f"{self.deg:.3f} {self.unit}"


@dataclass(frozen=True, slots=True)
class Limits:
    """Lowest and highest allowed user angle in degrees; None where there is no limit."""

    min_deg: float | None
    max_deg: float | None

    def __contains__(self, target_deg: float) -> bool:
        low = -math.inf if self.min_deg is None else self.min_deg - ROUNDING_DEG
        high = math.inf if self.max_deg is None else self.max_deg + ROUNDING_DEG
        return low <= target_deg <= high

    def __str__(self) -> str:
        return " to ".join("no limit" if end is None else f"{end:g}" for end in (self.min_deg, self.max_deg))


@dataclass(frozen=True, slots=True)
class AxisIdentity:
    """Identity of an axis: kind of driver, model, serial number, firmware, port and address."""

    kind: str
    model: str
    serial_number: str
    firmware: str
    port: str
    address: str


def _ascending(ends: tuple[float | None, float | None]) -> tuple[float | None, float | None]:
    low, high = ends
    if low is not None and high is not None and low >= high:
        raise ValueError(f"the limits {low:g} to {high:g} are high first or leave no way. Swap them")
    return ends


def stage_limit(told_deg: float) -> float | None:
    """A limit as the controller reports it, in degrees; None for a number so large that the stage has none."""
    return None if abs(told_deg) >= NO_LIMIT_DEG else told_deg


class AxisConfig(BaseModel):
    """What every kind of axis has in a rig file.

    The user angle is ``direction * (device angle - zero_deg)``: `zero_deg` is the angle that the controller
    shows where the user's angle is zero, and the only offset there is. Angles are never wrapped.

    Attributes
    ----------
    identified_by : str
        Name of the entry that says which device this is; a kind without `serial_number` names another. The driver
        refuses a device that does not answer to it (WrongDevice).
    unit : str
        Of positions and targets: "deg", or "V" for a liquid crystal. Values and entries in degrees (`_deg`) are in
        this unit.
    """

    identified_by: ClassVar[str] = "serial_number"
    unit: ClassVar[Literal["deg", "V"]] = "deg"

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    port: str = Field(description="device path, /dev/serial/by-id path or socket://host:port")
    held_by: str | None = Field(
        default=None, description="program that may hold the port too: the simulator behind a pseudo-terminal"
    )
    zero_deg: float = Field(default=0.0, description="controller angle at user angle zero")
    direction: Literal[1, -1] = Field(default=1, description="-1 if the user angle grows the other way")
    limits_deg: Annotated[tuple[float | None, float | None], AfterValidator(_ascending)] | None = Field(
        default=None, description="host limits in user degrees, checked besides those of the controller"
    )
    tolerance_deg: float = Field(
        default=0.05, gt=0, le=10, description="largest allowed distance from the target at rest"
    )
    poll_s: float = Field(default=0.03, gt=0, le=5, description="time between two looks at a moving axis")
    margin_s: float = Field(default=2.0, gt=0, le=600, description="added to the time that distance and speed allow")
    stall_s: float = Field(default=1.5, gt=0, le=600, description="moving without progress for so long is a stall")
    home_allowed_s: float | None = Field(default=None, gt=0, le=7200, description="longest homing; default from speed")
    reply_s: float | None = Field(default=None, gt=0, le=60, description="longest wait for a reply; default by kind")

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        if "kind" in cls.model_fields and cls.identified_by not in cls.model_fields:
            raise TypeError(
                f"{cls.__module__}.{cls.__qualname__} has no field {cls.identified_by!r}: a rig file must be able to "
                "say which device it means. Add the field, or name another one in `identified_by`"
            )

    def place(self) -> str:
        """What tells this axis from others on its line, in words; "" where a line has one axis only."""
        return ""

    def named_states(self) -> Mapping[str, float]:
        """Positions that the rig file gives a name, which a plan may use."""
        return {}
