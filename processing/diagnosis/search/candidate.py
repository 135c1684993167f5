"""Candidates: an effect at a place, with its parameters; and a value of the train that is only nominal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from processing.arrays import Array
from processing.effect import Effect, Parameter
from processing.errors import ProcessError
from processing.instrument.applied_effects import instrument_effects
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import FromAState, FromFileOnly, InstrumentEffect
from processing.instrument.model import InstrumentModel


@dataclass(frozen=True)
class Candidate:
    """One effect at one place; in one capture or at one wavelength, if its values belong to that alone.

    `starts` are values from which a fit starts, besides zero.
    """

    effect: Effect
    place: str
    parameters: tuple[Parameter, ...]
    capture: int | None = None
    starts: tuple[Array, ...] = field(default=(), compare=False)
    wavelength_nm: float | None = None

    def acts(self, capture: int, wavelength_nm: float) -> bool:
        """Whether it acts on a capture, by its number and wavelength."""
        return self.capture in (None, capture) and self.wavelength_nm in (None, wavelength_nm)

    @property
    def kind(self) -> str:
        """Kind of the effect."""
        return self.effect.kind

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def state_chosen(self) -> bool:
        """The state that it starts at is chosen among many."""
        return isinstance(self.effect, FromAState)

    @property
    def family(self) -> str:
        """Name without the state that a slip starts at."""
        where = self.effect.axis(self.place) if isinstance(self.effect, FromAState) else self.place
        return f"{self.kind}:{where}:{self.capture}"

    @property
    def short(self) -> str:
        """kind[element]."""
        return f"{self.kind}[{self.place}]" if self.place else self.kind

    @property
    def label(self) -> str:
        """Name for people."""
        where = f" in capture {self.capture + 1}" if self.capture is not None else ""
        return self.short + where + (f" at {self.wavelength_nm:g} nm" if self.wavelength_nm is not None else "")

    def apply(self, changes: Changes, model: InstrumentModel, values: Array) -> None:
        """Add the effect of these values to the changes of an instrument, if it is one of an instrument."""
        if isinstance(self.effect, InstrumentEffect):
            self.effect.apply(changes, model, self.place, values)

    @property
    def typical(self) -> Array:
        """Plausible size of each parameter."""
        return np.array([p.typical for p in self.parameters])

    @property
    def lower(self) -> Array:
        """Lower bounds."""
        return np.array([p.lower for p in self.parameters])

    @property
    def upper(self) -> Array:
        """Upper bounds."""
        return np.array([p.upper for p in self.parameters])


class NominalValue(InstrumentEffect):
    """A value of the train that the instrument file gives as only nominal (`calibrate`)."""

    FIELDS: ClassVar[dict[str, Parameter]] = {
        "azimuth_deg": Parameter("azimuth", "degree", -400, 400, 30.0),
        "retardance_deg": Parameter("retardance", "degree", -200, 200, 30.0),
        "extinction": Parameter("extinction", "1", -0.02, 1.0, 0.1),
        "diattenuation": Parameter("diattenuation", "1", -1.0, 1.0, 0.1),
    }

    def __init__(self, name: str, model: InstrumentModel) -> None:
        self.kind = "calibrate"
        self.element, _, self.field = name.rpartition(".")
        known = {e.name for e in model.elements()}
        if self.element not in known or self.field not in self.FIELDS:
            raise ProcessError(
                f"instrument {model.name!r}: calibrate: {name!r} is not ELEMENT.FIELD with an element of this "
                f"instrument and a field of {', '.join(self.FIELDS)}"
            )

    @property
    def shared(self) -> bool:
        """A mount, the same at every wavelength."""
        return self.field == "azimuth_deg"

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return (f"{self.element}.{self.field}",)

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return (self.FIELDS[self.field],)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        value = values[0]
        if self.field.endswith("_deg"):
            target = changes.azimuth_rad if self.field == "azimuth_deg" else changes.retardance_rad
            target[self.element] = target[self.element] + np.deg2rad(value)
        else:
            target = changes.extinction if self.field == "extinction" else changes.diattenuation
            target[self.element] = target[self.element] + value


def nominal_values(
    model: InstrumentModel, conditions: Conditions, wavelengths_nm: Sequence[float]
) -> tuple[Candidate, ...]:
    """Candidates for the values that the instrument file calls nominal: azimuths once, all else at every wavelength."""
    out = []
    several = sorted(set(wavelengths_nm))
    for name in model.calibrate:
        effect = NominalValue(name, model)
        shared = effect.shared or len(several) == 1
        for wavelength in (None,) if shared else several:
            parameters = effect.parameters(model, conditions, name)
            out.append(Candidate(effect, name, parameters, wavelength_nm=wavelength))
    return tuple(out)


def pool(
    model: InstrumentModel, conditions: Sequence[Conditions], wavelengths_nm: Sequence[float] | None = None
) -> tuple[Candidate, ...]:
    """Every effect of the instrument at every place of the captures, by default all at one wavelength.

    What shifts a value that is fitted as nominal is left out: the same number under two names would be a false pair of
    indistinguishable effects.
    """
    wavelengths_nm = wavelengths_nm or (0.0,) * len(conditions)
    found: dict[tuple[str, str, int | None, float | None], Candidate] = {}
    fitted = set(model.calibrate)
    several = len(set(wavelengths_nm)) > 1
    one_scale = len({c.full_scale for c in conditions}) == 1
    for effect in instrument_effects().values():
        if isinstance(effect, FromFileOnly):
            continue
        dispersive = several and (
            effect.belongs_to == "wavelength" or (effect.belongs_to == "detector" and not one_scale)
        )
        for k, (condition, wavelength) in enumerate(zip(conditions, wavelengths_nm, strict=True)):
            number = k if effect.belongs_to == "capture" else None
            own = wavelength if dispersive else None
            for place in effect.places(model, condition):
                if fitted.isdisjoint(effect.shifts(model, place)):
                    parameters = effect.parameters(model, condition, place)
                    candidate = Candidate(effect, place, parameters, number, effect.starts(), own)
                    found.setdefault((effect.kind, place, number, own), candidate)
    return tuple(found.values())
