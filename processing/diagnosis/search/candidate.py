"""Candidates: an effect at a place, with its parameters; and a value of the train that is only nominal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from processing.arrays import Array
from processing.errors import ProcessError
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import Effect, Parameter, all_effects
from processing.instrument.model import InstrumentModel


@dataclass(frozen=True)
class Candidate:
    """One effect at one place; of scope "capture", in one capture.

    `starts` are values from which a fit starts, besides zero.
    """

    effect: Effect
    place: str
    parameters: tuple[Parameter, ...]
    capture: int | None = None
    starts: tuple[Array, ...] = field(default=(), compare=False)

    @property
    def kind(self) -> str:
        """Kind of the effect."""
        return self.effect.kind

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def cost(self) -> float:
        """Parameters that a fit has to pay for; the state of a slip is chosen among many."""
        return self.size + (3.0 if "@" in self.place else 0.0)

    @property
    def family(self) -> str:
        """Name without the state that a slip starts at."""
        return f"{self.kind}:{self.place.partition('@')[0]}:{self.capture}"

    @property
    def short(self) -> str:
        """kind[element]."""
        return f"{self.kind}[{self.place}]" if self.place else self.kind

    @property
    def label(self) -> str:
        """Name for people."""
        return self.short + (f" in capture {self.capture + 1}" if self.capture is not None else "")

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


class NominalValue(Effect):
    """A value of the train that the instrument file gives as only nominal (`calibrate`)."""

    group = "optics"
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


def nominal_values(model: InstrumentModel, conditions: Conditions) -> tuple[Candidate, ...]:
    """Candidates for the values that the instrument file calls nominal."""
    out = []
    for name in model.calibrate:
        effect = NominalValue(name, model)
        out.append(Candidate(effect, name, effect.parameters(model, conditions, name)))
    return tuple(out)


def pool(model: InstrumentModel, conditions: Sequence[Conditions]) -> tuple[Candidate, ...]:
    """Every effect at every place of the captures; what turns a whole train is part of an unknown sample."""
    found: dict[tuple[str, str, int | None], Candidate] = {}
    fitted = _fitted_by_calibration(model)
    for effect in all_effects().values():
        if effect.group == "frame":
            continue
        for k, condition in enumerate(conditions):
            number = k if effect.scope == "capture" else None
            for place in effect.places(model, condition):
                if (effect.kind, place) in fitted:
                    continue
                parameters = effect.parameters(model, condition, place)
                starts = tuple(np.full(len(parameters), s) for s in getattr(effect, "starts", ()) if s)
                found.setdefault((effect.kind, place, number), Candidate(effect, place, parameters, number, starts))
    return tuple(found.values())


def _fitted_by_calibration(model: InstrumentModel) -> set[tuple[str, str]]:
    # The same number under two names would be a false pair of indistinguishable effects.
    out = set()
    generator = {e.name for e in model.generator}
    for name in model.calibrate:
        element, _, field_name = name.rpartition(".")
        train = "psg" if element in generator else "psa"
        out.add((f"{train}_{field_name.removesuffix('_deg')}", element))
        if element not in generator and field_name == "azimuth_deg":
            polarizer = next(e for e in model.elements() if e.name == element).kind == "polarizer"
            if polarizer:
                out |= {("analyzer_azimuth", ""), ("channel_azimuth", "")}
    return out
