"""Entries that `diagnose` writes into an instrument file: effects with their values, and the remaining uncertainty.

There are many uncertain directions. A file has their values by effect and no more: written as the effects of a
correction are, those of three captures took a file as long as none is read.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_serializer, field_validator

from processing.section import Section


class EffectParameter(Section):
    """A fitted value with its standard error (None: it has none, `note` says why); or one at each wavelength."""

    value: float | tuple[float, ...] = Field(description="fitted value")
    stderr: float | tuple[float, ...] | None = Field(default=None, description="its standard error")
    unit: str = Field(description="its unit")
    note: str | None = Field(default=None, description="why it has no standard error")
    wavelengths_nm: tuple[float, ...] | None = Field(
        default=None, description="wavelengths of the values, nm, where there are several"
    )

    @property
    def text(self) -> str:
        """The value to the last of two digits of its standard error; the range of many values."""
        if isinstance(self.value, tuple):
            return f"{len(self.value)} values, {min(self.value):.4g} to {max(self.value):.4g}"
        if not isinstance(self.stderr, float) or not 0 < self.stderr < np.inf:
            return f"{self.value:.5g}"
        digits = max(0, 1 - int(np.floor(np.log10(self.stderr))))
        return f"{self.value:.{digits}f} ± {self.stderr:.{digits}f}"


class AppliedEffect(Section):
    """One effect that `diagnose` found and added: what, where, how large, on which evidence."""

    kind: str
    element: str | None = Field(default=None, description="name of the element in the instrument file")
    parameters: dict[str, EffectParameter] = Field(description="values with their standard errors")
    evidence: float | None = Field(
        default=None, description="drop of the residual that speaks for it, as `diagnose` counts it"
    )
    captures: tuple[str, ...] = Field(
        default=(), description="captures that it holds in, where it is not the instrument's"
    )
    scope: Literal["instrument", "capture"] = Field(default="instrument", description="instrument, or single captures")
    wavelength_nm: float | None = Field(default=None, description="wavelength that it holds at, nm")
    indistinguishable_from: tuple[str, ...] = Field(default=(), description="effects that would look the same")
    probability: float | None = Field(
        default=None, description="how likely it is, given everything that was looked for"
    )

    @field_validator("captures")
    @classmethod
    def _short(cls, captures: tuple[str, ...]) -> tuple[str, ...]:
        """Files written before 24 November 2026 name a capture TITLE (FILE.h5)."""
        return tuple(re.sub(r".* \((.+)\.h5\)", r"\1", name) for name in captures)


#: Values by name of effects by label; values of many states in one text.
_AsWritten = dict[str, dict[str, float | str]]


class SystematicError(Section):
    """What stays uncertain after a correction, as independent directions of one standard deviation each.

    Together they are the covariance of all values of the posterior, as far as a Mueller matrix notices it. Each
    direction is a set of small effects that belong together.

    Attributes
    ----------
    directions
        Effects of each direction, the one that a Mueller matrix notices most first; in a file by label, with their
        values alone.
    rms_over_m00
        Standard error of the elements of M/m00 that all of them make in the captures they were found in.
    """

    directions: tuple[tuple[AppliedEffect, ...], ...] = Field(
        description="sets of small effects that belong together, one standard deviation each"
    )
    rms_over_m00: float = Field(description="standard error of an element of M / m00 that all of them make")
    wavelength_nm: float | None = Field(default=None, description="wavelength that it holds at, nm")

    @field_validator(
        "directions", mode="before", json_schema_input_type=tuple[_AsWritten | tuple[AppliedEffect, ...], ...]
    )
    @classmethod
    def _read(cls, directions: Any) -> Any:
        if not isinstance(directions, list | tuple):
            return directions
        return [_read_direction(direction) if isinstance(direction, Mapping) else direction for direction in directions]

    @field_serializer("directions", when_used="json")
    def _told(self, directions: tuple[tuple[AppliedEffect, ...], ...]) -> list[_AsWritten]:
        return [_direction_text(effect.model_dump() for effect in direction) for direction in directions]


#: kind[element] at 662 nm in air.h5
LABEL = re.compile(
    r"(?P<kind>[^\s\[]+)(?:\[(?P<element>[^\]]+)\])?(?: at (?P<wavelength_nm>[\d.]+) nm)?(?: in (?P<capture>.+))?"
)


def _direction_text(direction: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, float | str]]:
    """The values of effects (as mappings of their fields) by label; values of many states in one text."""
    texts: dict[str, dict[str, float | str]] = {}
    for effect in direction:
        values = {name: _number_or_text(p["value"]) for name, p in effect["parameters"].items()}
        label = effect["kind"] + (f"[{effect['element']}]" if effect["element"] else "")
        label += f" at {effect['wavelength_nm']:g} nm" if effect["wavelength_nm"] is not None else ""
        captures = [f" in {name}" for name in effect["captures"]] if effect["scope"] == "capture" else [""]
        texts |= {label + where: values for where in captures}
    return texts


def _read_direction(direction: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The effects, as mappings of their fields, of values by label.

    Raises ValueError: a label is none, or a text has no numbers.
    """
    effects = []
    for label, values in direction.items():
        place = LABEL.fullmatch(label)
        if place is None:
            raise ValueError(
                f"{label!r} is not KIND[ELEMENT] at WAVELENGTH nm in CAPTURE, of which KIND alone has to be"
            )
        fields: dict[str, Any] = {"kind": place["kind"], "element": place["element"]}
        if place["wavelength_nm"]:
            fields["wavelength_nm"] = float(place["wavelength_nm"])
        if place["capture"]:
            fields |= {"captures": (place["capture"],), "scope": "capture"}
        # The unit is that of the effect: nobody reads it here.
        fields["parameters"] = {name: {"value": _numbers(value), "unit": ""} for name, value in values.items()}
        effects.append(fields)
    return effects


def _number_or_text(value: float | Sequence[float]) -> float | str:
    return value if isinstance(value, float) else " ".join(map(str, value))


def _numbers(value: Any) -> Any:
    return tuple(float(number) for number in value.split()) if isinstance(value, str) else value
