"""A campaign: samples x wavelengths x modes x arm angles, as one frozen value, iterated into captures."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Discriminator, Field, Tag, model_validator

from acquisition.capture.plan import Auto, AutoExposure, MeasurementPlan, Mode, Seconds, exposure_kind
from processing.section import FiniteSection
from processing.storage.captures.schema import Sample
from processing.yaml_file import load_yaml
from processing.yaml_words import NAME_PATTERN

Angle = Annotated[float, Field(allow_inf_nan=False)]
ByWavelength = Annotated[dict[float, Annotated[float, Field(gt=0)]], Tag("by wavelength")]


class AngleSteps(FiniteSection):
    """Equal steps from `start` to `stop`, both included; at most 3600."""

    start: Angle = Field(description="first angle, degrees")
    stop: Angle = Field(description="last angle, degrees, included")
    step: Annotated[float, Field(gt=0, allow_inf_nan=False)] = Field(description="degrees between two angles")

    def angles_deg(self) -> tuple[float, ...]:
        """The angles, ascending."""
        count = int((self.stop - self.start) / self.step + 1e-9) + 1
        return tuple(round(self.start + k * self.step, 9) for k in range(count))

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        if self.stop < self.start:
            raise ValueError(f"stop {self.stop:g} lies before start {self.start:g}")
        if self.stop - self.start > 3600 * self.step:
            raise ValueError(f"step {self.step:g} makes more than 3600 angles")
        return self


class Reference(FiniteSection):
    """A capture of something known, taken first in each block and again after every `every` captures.

    A block is what is taken of one sample at one wavelength in one mode. `role` flat marks it as a flat field.
    """

    sample: Sample = Field(description="what it is of")
    omega_deg: Angle = Field(description="angle between source and camera, degrees")
    modes: tuple[str, ...] = Field(description="modes in which it is taken")
    every: int | None = Field(default=None, gt=0, description="again after so many captures; without it once a block")
    role: Literal["flat", "air", "sample"] | None = Field(default=None, description="flat marks a flat field")


class Campaign(FiniteSection):
    """What `acquire --campaign` takes. Relative paths are relative to the campaign file.

    `plans` names the plan of each mode, whose sample, wavelength, angle and exposure the campaign replaces.
    `exposure_s` is one value, or one for each wavelength in nm, or {kind: auto}. `retries` is how often a capture
    that a device or the disc ended is gone on with unattended, axes opened anew and without asking whether they are
    free: 0 where somebody should look first.

    Examples
    --------
    >>> from acquisition import Campaign
    >>> campaign = Campaign.load("campaigns/red_sphere.yaml")
    >>> campaign.name, campaign.wavelengths_nm
    ('red_sphere', (451.0, 662.0))
    """

    kind: Literal["campaign"] = "campaign"
    name: str = Field(pattern=NAME_PATTERN, description="name of the folder that the captures go into")
    rig: Path | None = Field(default=None, description="rig file, relative to this file; --rig replaces it")
    plans: dict[Mode, Path] = Field(
        min_length=1,
        description="plan file of each mode; the campaign replaces sample, wavelength, angle and exposure in it",
    )
    samples: tuple[Sample, ...] = Field(
        min_length=1, description="what is measured, one after another; each change is asked for"
    )
    wavelengths_nm: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        min_length=1, description="wavelengths, nm, as the rig has them"
    )
    omega_deg: AngleSteps | Annotated[tuple[Angle, ...], Field(min_length=1)] = Field(
        description="angles between source and camera: a list, or equal steps; taken upwards"
    )
    exposure_s: Annotated[Seconds | ByWavelength | Auto, Discriminator(exposure_kind)] | None = Field(
        default=None, description="seconds, or seconds for each wavelength, or {kind: auto}; without it the plan's"
    )
    references: tuple[Reference, ...] = Field(
        default=(), description="captures of something known, first in each block and again after every so many"
    )
    retries: int = Field(
        default=0, ge=0, le=100, description="how often a capture that a device ended is gone on with unattended"
    )
    retry_wait_s: float = Field(default=5.0, ge=0, description="pause before such a retry, s")
    continue_after_interlock: bool = Field(
        default=False, description="go on by itself when an interlock closes again, if its reason is one that passes"
    )

    @model_validator(mode="after")
    def _references_have_a_plan(self) -> Self:
        for reference in self.references:
            unknown = sorted(set(reference.modes) - set(self.plans))
            if unknown or not reference.modes:
                modes = ", ".join(self.plans)
                raise ValueError(f"a reference in mode {', '.join(unknown) or 'none'}; `plans` has {modes}")
        return self

    @model_validator(mode="after")
    def _nothing_twice(self) -> Self:
        angles = () if isinstance(self.omega_deg, AngleSteps) else self.omega_deg
        for kind, values in (
            ("wavelength", self.wavelengths_nm), ("angle", angles), ("sample", [s.name or s.kind for s in self.samples])
        ):  # fmt: skip
            for k, value in enumerate(values):
                if value in values[:k]:
                    raise ValueError(f"the {kind} {value} is listed twice; each is taken once")
        return self

    @classmethod
    def load(cls, path: Path | str) -> "Campaign":
        """Read a campaign file; its paths become absolute. Raises ConfigError with file, line and key."""
        campaign = load_yaml(path, cls)
        folder = Path(path).resolve().parent
        plans = {mode: folder / plan for mode, plan in campaign.plans.items()}
        rig = folder / campaign.rig if campaign.rig is not None else None
        return campaign.model_copy(update={"plans": plans, "rig": rig})

    def angles_deg(self) -> tuple[float, ...]:
        """Arm angles, ascending: the arm comes to each from the same side, and back only once a block."""
        if isinstance(self.omega_deg, AngleSteps):
            return self.omega_deg.angles_deg()
        return tuple(sorted(self.omega_deg))


class CampaignCapture(FiniteSection):
    """One capture of a campaign: its number from 1, its file name, its plan, and whether it is a reference."""

    number: int
    name: str
    plan: MeasurementPlan
    reference: bool = False


def captures(campaign: Campaign) -> Iterator[CampaignCapture]:
    """All captures in the order in which they are taken.

    What needs a person changes least often: the sample outermost, then the wavelength, then the mode (another
    camera); the arm turns innermost, always upwards.
    """
    number = 0
    plans = {mode: MeasurementPlan.load(path) for mode, path in campaign.plans.items()}
    for sample in campaign.samples:
        for wavelength in campaign.wavelengths_nm:
            for mode, plan in plans.items():
                common = {
                    "mode": mode,
                    "wavelength_nm": wavelength,
                    "exposure_s": _exposure(campaign, wavelength),
                    "continue_after_interlock": campaign.continue_after_interlock,
                }
                for index, omega in enumerate(campaign.angles_deg()):
                    for reference in campaign.references:
                        due = index == 0 or (reference.every is not None and index % reference.every == 0)
                        if due and mode in reference.modes:
                            number += 1
                            reference_plan = plan.with_changes(
                                **common, sample=reference.sample, omega_deg=reference.omega_deg, role=reference.role
                            )
                            yield _capture(number, reference_plan, True)
                    number += 1
                    yield _capture(number, plan.with_changes(**common, sample=sample, omega_deg=omega), False)


def _capture(number: int, plan: MeasurementPlan, reference: bool) -> CampaignCapture:
    sample = "".join(c if c.isalnum() else "_" for c in plan.sample.name or plan.sample.kind)
    name = f"{number:03d}_{sample}_{plan.mode}_{plan.wavelength_nm:g}nm_omega{plan.omega_deg:g}.h5"
    return CampaignCapture(number=number, name=name, plan=plan, reference=reference)


def _exposure(campaign: Campaign, wavelength_nm: float) -> float | AutoExposure | None:
    if isinstance(campaign.exposure_s, dict):
        for key, value in campaign.exposure_s.items():
            if abs(key - wavelength_nm) < 0.5:
                return value
        return None
    return campaign.exposure_s
