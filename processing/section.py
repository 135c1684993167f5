"""What a section of a file of ours is: fixed once read, without unknown keys."""

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """A section of a file: unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class FiniteSection(Section):
    """A section that refuses numbers that are not finite as well."""

    model_config = ConfigDict(allow_inf_nan=False)
