"""Optical elements of an instrument: polarizers, retarders, diattenuators, fixed or turned by a named axis."""

from collections.abc import Mapping
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Field, model_validator

from processing.arrays import Array
from processing.errors import ProcessError
from processing.instrument.changes import Changes
from processing.polarization import mueller
from processing.section import Section

#: A number, or one number for each wavelength in nm.
Dispersive = float | dict[float, float]


class WavelengthError(ProcessError):
    """The instrument model has no value for the wavelength asked for."""


class Uncertain(Section):
    """A number with its standard uncertainty, as a file may state it."""

    value: float = Field(description="the number")
    u: float = Field(description="its standard uncertainty, in its unit")


#: A number, or one for each wavelength, each with its u or without; `InstrumentModel.stderr` then holds the u.
Stated = Annotated[
    Dispersive,
    BeforeValidator(lambda value: value, json_schema_input_type=float | Uncertain | dict[float, float | Uncertain]),
]


class Element(Section):
    """One optical element, fixed or turned: azimuth = azimuth_deg + ratio * angle of `axis`."""

    name: str = Field(description="name that messages and other files use")
    azimuth_deg: Stated = Field(default=0.0, description="azimuth at zero of the axis, degrees from +x towards +y")
    axis: str | None = Field(default=None, description="name of the axis")
    ratio: Annotated[float, BeforeValidator(lambda value: value, json_schema_input_type=float | Uncertain)] = Field(
        default=1.0, description="degrees of the element for one degree of its axis"
    )

    @model_validator(mode="after")
    def _ratio_needs_axis(self) -> Self:
        if self.axis is None and self.ratio != 1.0:
            raise ValueError(f"element {self.name!r} has a ratio but no axis that turns it")
        return self

    def azimuth_rad(self, angles_deg: Mapping[str, ArrayLike], states: int) -> Array:
        """Azimuth (states,) in radians; angles_deg holds the angle of each axis for each state."""
        azimuth = np.full(states, number(self.azimuth_deg))
        if self.axis is not None:
            if self.axis not in angles_deg:
                axes = ", ".join(sorted(angles_deg)) or "none"
                raise KeyError(f"element {self.name!r} turns with axis {self.axis!r}; the states have: {axes}")
            azimuth = azimuth + self.ratio * np.asarray(angles_deg[self.axis], dtype=float)
        return np.asarray(np.deg2rad(azimuth))

    def mueller(self, azimuth_rad: Array, changes: Changes | None = None) -> Array:
        """Mueller matrices (states, 4, 4) of the element at each azimuth, with what effects change in it."""
        raise NotImplementedError


class Polarizer(Element):
    """Polarizer; `extinction` is the intensity leak T_min/T_max, `ellipticity_deg` that of what it transmits."""

    kind: Literal["polarizer"]
    extinction: Stated = Field(default=0.0, description="intensity leak T_min / T_max")
    ellipticity_deg: Stated = Field(
        default=0.0, description="ellipticity of the light that it transmits, degrees; 0 linear, 45 right circular"
    )

    def mueller(self, azimuth_rad: Array, changes: Changes | None = None) -> Array:
        extinction = number(self.extinction) + (changes.extinction[self.name] if changes else 0.0)
        return mueller.polarizer(azimuth_rad, extinction, np.deg2rad(number(self.ellipticity_deg)))


class Retarder(Element):
    """Linear retarder with its fast axis at the azimuth; `diattenuation` (T_f - T_s)/(T_f + T_s) is along it.

    `depolarization` is the share of what the retardance acts on that is lost, because light of several retardances is
    summed: a normal distribution of width s (radians; from the bandwidth, or over the aperture) loses 1 - exp(-s^2/2).
    """

    kind: Literal["retarder"]
    retardance_deg: Stated = Field(description="retardance, degrees; one number, or one for each wavelength in nm")
    diattenuation: Stated = Field(default=0.0, description="(T_fast - T_slow) / (T_fast + T_slow)")
    depolarization: Stated = Field(
        default=0.0,
        description="share of what the retardance acts on that is lost to the mean over several retardances",
    )

    def mueller(self, azimuth_rad: Array, changes: Changes | None = None) -> Array:
        retardance = np.deg2rad(number(self.retardance_deg)) + (changes.retardance_rad[self.name] if changes else 0.0)
        lost = number(self.depolarization) + (changes.depolarization[self.name] if changes else 0.0)
        plain = mueller.retarder(azimuth_rad, retardance, lost)
        d = number(self.diattenuation) + (changes.diattenuation[self.name] if changes else 0.0)
        if np.all(d == 0.0):
            return plain
        return mueller.diattenuator(azimuth_rad, 1 + d, 1 - d) @ plain


class Diattenuator(Element):
    """Linear diattenuator with intensity transmissions `t_max` along the azimuth and `t_min` across it."""

    kind: Literal["diattenuator"]
    t_max: Stated = Field(default=1.0, description="intensity transmission along the azimuth")
    t_min: Stated = Field(description="intensity transmission across it")

    def mueller(self, azimuth_rad: Array, changes: Changes | None = None) -> Array:
        return mueller.diattenuator(azimuth_rad, number(self.t_max), number(self.t_min))


AnyElement = Annotated[Polarizer | Retarder | Diattenuator, Field(discriminator="kind")]


def number(value: Dispersive) -> float:
    """The value, once a wavelength is chosen; WavelengthError before."""
    if isinstance(value, dict):
        raise WavelengthError("the instrument model has values for several wavelengths: choose one with .at()")
    return float(value)
