"""The effect on a Mueller matrix of each value that `diagnose` wrote into an instrument file."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processing.arrays import Array
from processing.effect import EffectError
from processing.instrument.applied_effects import changes_of, instrument_effects
from processing.instrument.changes import Conditions
from processing.instrument.determined_basis import LEAST, determined_basis
from processing.instrument.elements import Dispersive, number
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.instrument.nominal import KIND

#: States at which an effect is looked at: enough for all unknowns, without regularity.
STATES = 61


@dataclass(frozen=True)
class Influence:
    """One line about a file.

    Attributes
    ----------
    name, value : what it is, and its number with its standard error.
    scope : which captures it holds for.
    change : rms over the elements of M/m00 of air by which it changes M; None where that depends on the capture.
    fitted : a value of the train; `change` is that of one standard error of it.
    """

    name: str
    value: str
    scope: str
    change: float | None
    fitted: bool = False


def influences(model: InstrumentModel, wavelength_nm: float | None = None) -> list[Influence]:
    """All values that `diagnose` wrote, in the order of the file.

    Parameters
    ----------
    wavelength_nm : at which the change of M is taken; default: of each effect its own, else the first of the file.

    Raises
    ------
    WavelengthError : the file has no values at this wavelength.
    """
    wavelengths = [e.wavelength_nm for e in model.effects if e.wavelength_nm is not None]
    nm = wavelength_nm or (*(model.wavelengths_nm or ()), *wavelengths, 0.0)[0]
    at = model.at(nm)
    random = np.random.default_rng(0)
    angles = {axis: random.uniform(0, 360, STATES) for axis in at.axes or ("none",)}
    where = Conditions.of(angles, tuple(c.name for c in at.channels))
    result = []
    for name, stderr in model.stderr.items():
        step = at.stderr.get(name, 0.0)
        shift = AppliedEffect(
            kind=KIND, element=name, parameters={"shift": EffectParameter(value=number(step), unit="")}
        )
        change = _change(at, (*at.effects, shift), at.effects, where)
        value = _numbers(model.value_of(name), stderr)
        result.append(Influence(name, value, "later captures at all wavelengths", change, fitted=True))
    for effect in model.effects:
        model_at = at if wavelength_nm or effect.wavelength_nm is None else model.at(effect.wavelength_nm)
        result.append(Influence(_name(effect), _values(effect), _scope(effect), _change_by(model_at, effect, where)))
    return result


def _change_by(model: InstrumentModel, effect: AppliedEffect, where: Conditions) -> float | None:
    listed = instrument_effects().get(effect.kind)
    if effect not in model.effects or (listed is not None and listed.acts_on_counts(effect.element or "")):
        return None
    always = effect.model_copy(update={"scope": "instrument"})
    remaining = tuple(e for e in model.effects if e != effect and e.scope == "instrument")
    return _change(model, (*remaining, always), remaining, where)


def _change(
    model: InstrumentModel, first: Sequence[AppliedEffect], second: Sequence[AppliedEffect], where: Conditions
) -> float | None:
    """Rms over the elements of M/m00 of air by which two lists of effects differ."""
    basis = determined_basis(model)
    try:
        rows = [_rows(model, tuple(effects), where) for effects in (first, second)]
    except (EffectError, ValueError):
        # A value for each state of another capture.
        return None
    air = basis @ (basis.T @ np.eye(4).reshape(16))
    w, shift = rows[1] @ basis, (rows[0] - rows[1]) @ air
    if model.projects_source:
        # Levels of the source are free: what moves both channels alike moves them.
        level = rows[1] @ air
        level /= np.linalg.norm(level, axis=1, keepdims=True)
        w = w - level[..., None] * np.sum(level[..., None] * w, axis=1, keepdims=True)
        shift = shift - level * np.sum(level * shift, axis=1, keepdims=True)
    moved = basis @ np.linalg.lstsq(w.reshape(-1, basis.shape[1]), shift.ravel(), rcond=LEAST)[0]
    moved = moved - moved[0] * air / air[0]
    return float(np.sqrt(np.sum(moved**2) / max(basis.shape[1] - 1, 1)) / air[0])


def _rows(model: InstrumentModel, effects: tuple[AppliedEffect, ...], where: Conditions) -> Array:
    variant = model.model_copy(update={"effects": effects})
    changes = changes_of(variant, where)
    return variant.rows(where.angles_deg, changes)


def _name(effect: AppliedEffect) -> str:
    at = "" if effect.wavelength_nm is None else f" at {effect.wavelength_nm:g} nm"
    return effect.kind + (f"[{effect.element}]" if effect.element else "") + at


def _values(effect: AppliedEffect) -> str:
    def one(name: str, p: EffectParameter) -> str:
        return f"{name} {p.text}" + ("" if p.unit in ("1", "") else f" {p.unit}")

    return ", ".join(one(name, p) for name, p in effect.parameters.items())


def _scope(effect: AppliedEffect) -> str:
    wavelengths = "at all wavelengths" if effect.wavelength_nm is None else f"at {effect.wavelength_nm:g} nm"
    if effect.scope == "instrument":
        return f"later captures {wavelengths}"
    return f"{' and '.join(effect.captures)} alone, {wavelengths}"


def _numbers(value: Dispersive | None, stderr: Dispersive) -> str:
    def at(of: Dispersive | None, nm: float) -> float:
        return of.get(nm, 0.0) if isinstance(of, dict) else of or 0.0

    at_nm = sorted({nm for of in (value, stderr) if isinstance(of, dict) for nm in of})
    text = [
        (EffectParameter(value=at(value, nm), stderr=at(stderr, nm), unit="").text, f" at {nm:g} nm") for nm in at_nm
    ]
    if not at_nm:
        text = [(EffectParameter(value=at(value, 0.0), stderr=at(stderr, 0.0), unit="").text, "")]
    return ", ".join(number + where for number, where in text)
