"""Candidates: an effect at a place, with its parameters; and a value of the train that is only nominal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.dispersion import Curve, curve
from processing.diagnosis.search.rules import NOMINAL_DEG, NOMINAL_PART, NOMINAL_SHARE, WINDOW_DEG
from processing.effect import Effect, Parameter
from processing.errors import ProcessError
from processing.instrument.applied_effects import instrument_effects
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import InstrumentEffect, SourceEffect, ValuePerState
from processing.instrument.model import Belongs, EffectParameter, InstrumentModel
from processing.instrument.nominal import FIELDS, KIND, shift_nominal


@dataclass(frozen=True)
class Candidate:
    """One effect at one place; in one capture or at one wavelength, if its values belong to that alone.

    With a `curve` the values are a smooth function of the wavelength, and `parameters` its coefficients.
    """

    effect: Effect
    place: str
    parameters: tuple[Parameter, ...]
    capture: int | None = None
    wavelength_nm: float | None = None
    curve: Curve | None = None
    price: float = field(default=0.0, compare=False)

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
        return self.effect.slips(self.place) is not None

    @property
    def moves_image(self) -> bool:
        """Whether it moves the image, and is undone by moving the frames back."""
        return self.effect.moves_image(self.place)

    @property
    def reaches_around(self) -> bool:
        """Whether it mixes a pixel with those around it."""
        return self.effect.reaches_around(self.place)

    @property
    def is_pointwise(self) -> bool:
        """Whether it changes every count by itself."""
        return self.effect.is_pointwise(self.place)

    @property
    def acts_on_counts(self) -> bool:
        """Whether it changes the counts and not the rows of W."""
        return self.effect.acts_on_counts(self.place)

    @property
    def of_instrument(self) -> InstrumentEffect | None:
        """The effect, if it is one of an instrument and not of a reflectance."""
        return self.effect if isinstance(self.effect, InstrumentEffect) else None

    def shifts(self, model: InstrumentModel) -> tuple[str, ...]:
        """Values of the train that it shifts and does nothing else."""
        return self.of_instrument.shifts(model, self.place) if self.of_instrument else ()

    @property
    def family(self) -> str:
        """Name without the state that a slip starts at."""
        where, _ = self.effect.slips(self.place) or (self.place, 0)
        return f"{self.kind}:{where}:{self.capture}"

    def at(self, wavelength_nm: float) -> Candidate:
        """The candidate at one wavelength: the same, unless its values are a curve over the wavelengths."""
        if self.curve is None:
            return self
        return replace(self, parameters=self.curve.parameters, wavelength_nm=wavelength_nm, curve=None)

    def matrix(self, wavelength_nm: float) -> Array:
        """Matrix (own values, size) that makes the values at one wavelength of those that are fitted."""
        return np.eye(self.size) if self.curve is None else self.curve.at(wavelength_nm)

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
        if self.of_instrument:
            if self.curve is not None:
                (wavelength,) = model.wavelengths_nm or ()
                values = self.matrix(wavelength) @ values
            self.of_instrument.apply(changes, model, self.place, values)

    @property
    def scope(self) -> Literal["instrument", "capture"]:
        """Whether it holds for the instrument or for one capture of it."""
        return "capture" if self.effect.of_one_capture else "instrument"

    def stored(self, values: Array, stderr: Array) -> dict[str, EffectParameter]:
        """Values by name as a file stores them, each with its standard error."""
        if self.effect.is_switch:
            return {"left_out": EffectParameter(value=1.0, unit="1", note="pixels with a clipped state are left out")}
        if self.effect.per_state:
            unit = self.parameters[0].unit
            return {"states": EffectParameter(value=tuple(values.tolist()), stderr=tuple(stderr.tolist()), unit=unit)}
        return {
            p.name: EffectParameter(value=float(v), stderr=float(s), unit=p.unit)
            for p, v, s in zip(self.parameters, values, stderr, strict=True)
        }

    def by_wavelength(self, values: Array, covariance: Array) -> Iterator[tuple[Candidate, Array, Array]]:
        """Itself, its values (n,) and their covariance (n, n); of a curve, each at every one of its wavelengths."""
        if self.curve is None:
            yield self, values, covariance
            return
        for wavelength in self.curve.wavelengths_nm:
            mix = self.matrix(wavelength)
            yield self.at(wavelength), mix @ values, mix @ covariance @ mix.T

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


#: [1] How far below its nominal value a gain of a channel, or the level of a source, may be.
MOST_LOST = 0.95


def _nominal(field: str, window: bool) -> Parameter:
    """A nominal value; what has no retardance is a window, and close to that."""
    if field == "azimuth_deg":
        return Parameter("azimuth", "degree", -400.0, 400.0, NOMINAL_DEG)
    if field == "retardance_deg":
        reach, size = (40.0, WINDOW_DEG) if window else (200.0, NOMINAL_DEG)
        return Parameter("retardance", "degree", -reach, reach, size)
    if field == "diattenuation":
        return Parameter(field, "1", -1.0, 1.0, NOMINAL_SHARE)
    if field == "gain":
        return Parameter(field, "1", -MOST_LOST, np.inf, NOMINAL_PART)
    return Parameter(field, "1", -NOMINAL_SHARE, 1.0, NOMINAL_PART if field == "extinction" else NOMINAL_SHARE)


class NominalValue(InstrumentEffect):
    """A value of the train that the instrument file gives as only nominal (`calibrate`)."""

    is_nominal = True

    #: A mount is the same at every wavelength; retardances and diattenuations follow a curve.
    BELONGS: ClassVar[dict[str, Belongs]] = {
        "azimuth_deg": "mechanics",
        "retardance_deg": "dispersion",
        "diattenuation": "dispersion",
        "depolarization": "dispersion",
        "gain": "detector",
    }

    def __init__(self, name: str, model: InstrumentModel) -> None:
        self.kind = KIND
        self.name = name
        self.field = name.rpartition(".")[2]
        if self.field not in FIELDS or model.value_of(name) is None:
            raise ProcessError(
                f"instrument {model.name!r}: calibrate: {name!r} is not ELEMENT.FIELD with an element of this "
                f"instrument and a field of {', '.join(FIELDS[:-1])}, nor CHANNEL.gain"
            )

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return (self.name,)

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return (_nominal(self.field, model.value_of(self.name) == 0),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        shift_nominal(changes, model, place, values[0])


class SourceLevel(SourceEffect, ValuePerState):
    """The level of a source that several channels see, in each state of a capture: always there, and no fault."""

    kind = "source_level"
    is_projected = True

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if conditions.states > 1 else ()

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        states = range(conditions.states)
        return tuple(Parameter(f"state_{k}", "1", -MOST_LOST, np.inf, NOMINAL_SHARE) for k in states)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.gain = changes.gain * (1 + values)[:, None]


def nominal_values(
    model: InstrumentModel, conditions: Conditions, wavelengths_nm: Sequence[float]
) -> tuple[Candidate, ...]:
    """Candidates for the values that the instrument file calls nominal: azimuths once, all else at every wavelength."""
    candidates: list[Candidate] = []
    for name in model.calibrate:
        effect = NominalValue(name, model)
        belongs = model.belongs_to.get(name, NominalValue.BELONGS.get(effect.field, "wavelength"))
        parameters = effect.parameters(model, conditions, name)
        candidates += _over_wavelengths(Candidate(effect, name, parameters), belongs, wavelengths_nm)
    return tuple(candidates)


def pool(
    model: InstrumentModel, conditions: Sequence[Conditions], wavelengths_nm: Sequence[float] | None = None
) -> tuple[Candidate, ...]:
    """Every effect of the instrument at every place of the captures, by default all at one wavelength.

    Effects that shift a fitted nominal value are excluded: the same number with two names would be a false pair of
    indistinguishable effects.
    """
    wavelengths_nm = wavelengths_nm or (0.0,) * len(conditions)
    candidates: dict[tuple[str, str, int | None], list[Candidate]] = {}
    fitted = set(model.calibrate)
    one_scale = len({c.full_scale for c in conditions}) == 1
    _check_declared(model)
    for effect in instrument_effects().values():
        if effect.from_file_only:
            continue
        belongs = model.belongs_to.get(effect.kind, effect.belongs_to)
        if belongs == "detector" and not one_scale and effect.kind not in model.belongs_to:
            belongs = "wavelength"
        for k, condition in enumerate(conditions):
            number = k if belongs == "capture" else None
            for place in effect.places(model, condition):
                if (effect.kind, place, number) not in candidates and fitted.isdisjoint(effect.shifts(model, place)):
                    parameters = effect.parameters(model, condition, place)
                    price = effect.log_price(model, condition, place)
                    candidate = Candidate(effect, place, parameters, number, price=price)
                    candidates[effect.kind, place, number] = _over_wavelengths(candidate, belongs, wavelengths_nm)
    return tuple(c for each in candidates.values() for c in each)


def _over_wavelengths(candidate: Candidate, belongs: Belongs, wavelengths_nm: Sequence[float]) -> list[Candidate]:
    """The candidate as it is in captures at several wavelengths: one for all, a smooth curve, or one at each."""
    several = sorted(set(wavelengths_nm))
    if len(several) == 1 or belongs not in ("dispersion", "wavelength"):
        return [candidate]
    smooth = curve(several, candidate.parameters) if belongs == "dispersion" else None
    if smooth is None:
        return [replace(candidate, wavelength_nm=w) for w in several]
    return [replace(candidate, parameters=smooth.coefficients, curve=smooth)]


def _check_declared(model: InstrumentModel) -> None:
    """Check that the effects in `belongs_to` exist."""
    unknown = [name for name in model.belongs_to if name not in instrument_effects() and name not in model.calibrate]
    if unknown:
        raise ProcessError(
            f"instrument {model.name!r}: belongs_to: {', '.join(unknown)} is neither a kind of effect nor a value that "
            "`calibrate` lists"
        )
