"""The effects that an instrument file names: what they change in the forward model of one capture."""

from collections.abc import Mapping
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from processing.effect import EffectError, Parameter, load_effects
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import InstrumentEffect
from processing.instrument.model import AppliedEffect, InstrumentModel
from processing.instrument.nominal import KIND, shift_nominal

#: Entry points of packages outside that add effects.
ENTRY_POINTS = "umov.effects"


@cache
def instrument_effects() -> dict[str, InstrumentEffect]:
    """Effects of the instrument by kind: the files of the folder, then plug-ins."""
    return load_effects("processing.instrument.effects", InstrumentEffect, ENTRY_POINTS)  # type: ignore[type-abstract]


def apply_to(changes: Changes, model: InstrumentModel, applied: AppliedEffect) -> None:
    """Add one effect of an instrument file to the changes. Raises EffectError: no such kind, place or parameter."""
    if applied.kind == KIND:
        (value,) = applied.parameters.values()
        if model.value_of(applied.element or "") is None:
            raise EffectError(f"{KIND}: {applied.element!r} is no value of instrument {model.name!r}")
        shift_nominal(changes, model, applied.element or "", float(np.asarray(value.value)))
        return
    effects = instrument_effects()
    if applied.kind not in effects:
        raise EffectError(f"effect {applied.kind!r} does not exist; there are: {', '.join(sorted(effects))}")
    effect, place = effects[applied.kind], applied.element or ""
    if place not in effect.places(model, changes.conditions) and not _acts_elsewhere(effect, place, model, changes):
        raise EffectError(f"effect {applied.kind!r} cannot act on {place!r} in instrument {model.name!r}")
    parameters = effect.parameters(model, changes.conditions, place)
    effect.apply(changes, model, place, _values(applied, effect, parameters))


def _acts_elsewhere(effect: InstrumentEffect, place: str, model: InstrumentModel, changes: Changes) -> bool:
    """Whether an axis that stands still in this capture would make it a place; what was found there holds here too."""
    turned = {axis: np.arange(8.0) ** 2 for axis in model.axes}
    return bool(turned) and place in effect.places(model, Conditions.of(turned, changes.conditions.channels))


def _values(applied: AppliedEffect, effect: InstrumentEffect, parameters: tuple[Parameter, ...]) -> NDArray[np.float64]:
    if effect.per_state:
        (entry,) = applied.parameters.values()
        values = np.asarray(entry.value, dtype=float).reshape(-1)
        if values.size != len(parameters):
            raise EffectError(
                f"effect {applied.kind!r} has {values.size} values and the capture has {len(parameters)} states"
            )
        return values
    missing = [p.name for p in parameters if p.name not in applied.parameters]
    if missing:
        raise EffectError(f"effect {applied.kind!r} lacks: {', '.join(missing)}")
    return np.array([applied.parameters[p.name].value for p in parameters], dtype=float)


def changes_of(model: InstrumentModel, conditions: Conditions, capture: str | None = None) -> Changes:
    """Changes by the instrument's effects; those of scope "capture" only if `capture` is among their captures."""
    changes = Changes(conditions)
    for applied in model.effects:
        if applied.scope == "instrument" or (capture is not None and capture in applied.captures):
            apply_to(changes, model, applied)
    return changes


def changes_at(model: InstrumentModel, angles_deg: Mapping[str, ArrayLike]) -> Changes:
    """Changes by the instrument's own effects at angles (axis name to (N,)) that belong to no capture."""
    arrays = {axis: np.asarray(angle, dtype=float).reshape(-1) for axis, angle in angles_deg.items()}
    return changes_of(model, Conditions.of(arrays, tuple(c.name for c in model.channels)))
