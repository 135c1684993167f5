"""What an effect is: one thing that a model can lack, with parameters that do nothing at zero."""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from typing import ClassVar, Literal

import numpy as np

from processing.arrays import Array
from processing.errors import ProcessError
from processing.instrument.changes import Changes, Conditions
from processing.instrument.model import AppliedEffect, InstrumentModel, Retarder

Group = Literal["optics", "frame", "motion", "source", "detector", "mosaic", "reflectance"]
Scope = Literal["instrument", "capture"]

ENTRY_POINT_GROUP = "umov.effects"


class EffectError(ProcessError):
    """An instrument file names an effect that does not exist or does not fit."""


@dataclass(frozen=True)
class Parameter:
    """One number of an effect; at zero it does nothing.

    Attributes
    ----------
    name, unit : as shown and stored.
    lower, upper : bounds.
    typical : a plausible size; sets steps and the weak prior (ten times this) that holds what data cannot see.
    """

    name: str
    unit: str
    lower: float
    upper: float
    typical: float


class Effect(ABC):
    """One effect. Its `kind` is the name of its file; the module's docstring says what causes and what mends it.

    Attributes
    ----------
    group : where it happens; "frame" turns all of a train, which only a known surface shows.
    scope : "capture" if another capture of the same instrument would have other values.
    per_state : parameter k acts on state k alone (which also makes its derivative cheap).
    corrects_counts : it is undone in the counts, not put into the rows of W.
    pointwise : it is undone in each pixel by itself, by `undo`.
    moves_image : it moves the image (`Changes.shift_px`); it is undone by moving the frames back.
    switch : it is on or off; its parameter is not fitted.
    """

    kind: str = ""
    group: ClassVar[Group]
    scope: ClassVar[Scope] = "instrument"
    per_state: ClassVar[bool] = False
    corrects_counts: ClassVar[bool] = False
    pointwise: ClassVar[bool] = False
    moves_image: ClassVar[bool] = False
    switch: ClassVar[bool] = False

    def first_state(self, place: str) -> int:
        """State from which on an axis error of one parameter acts; 0 for every other effect."""
        return 0

    def undo(self, signal: Array, conditions: Conditions, values: Array) -> tuple[Array, Array]:
        """Signal (counts over full scale) without the effect, exactly, and its slope; of `pointwise` effects only."""
        return signal, np.ones_like(signal)

    @abstractmethod
    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        """Where it can act in this instrument: element, axis or channel names; ("",) for the whole; () for nowhere."""

    @abstractmethod
    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        """The parameters at a place."""

    @abstractmethod
    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        """Add the effect of `values`, one for each parameter, to the changes."""


@cache
def all_effects() -> dict[str, Effect]:
    """Effects by kind: each module of this folder that has a class `This`, then plug-ins."""
    found = effects_in("processing.instrument.effects")
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        found[entry.name] = entry.load()()
        found[entry.name].kind = entry.name
    return found


def effects_in(package: str) -> dict[str, Effect]:
    """Effects by kind: each module of a package that has a class `This`."""
    found: dict[str, Effect] = {}
    for info in sorted(pkgutil.iter_modules(importlib.import_module(package).__path__), key=lambda i: i.name):
        module = importlib.import_module(f"{package}.{info.name}")
        if hasattr(module, "This"):
            found[info.name] = module.This()
            found[info.name].kind = info.name
    return found


def apply_to(changes: Changes, model: InstrumentModel, applied: AppliedEffect) -> None:
    """Add one effect of an instrument file to the changes.

    Raises
    ------
    EffectError : no such kind, place or parameter.
    """
    effects = all_effects()
    if applied.kind not in effects:
        raise EffectError(f"effect {applied.kind!r} does not exist; there are: {', '.join(sorted(effects))}")
    effect, place = effects[applied.kind], applied.element or ""
    # An axis that stands still in this capture is no place to search, but what was found elsewhere holds there too.
    turned = {axis: np.arange(8.0) ** 2 for axis in model.axes}
    anywhere = effect.places(model, Conditions.of(turned, changes.conditions.channels)) if turned else ()
    if place not in anywhere and place not in effect.places(model, changes.conditions):
        raise EffectError(f"effect {applied.kind!r} cannot act on {place!r} in instrument {model.name!r}")
    parameters = effect.parameters(model, changes.conditions, place)
    if effect.per_state:
        (entry,) = applied.parameters.values()
        values = np.asarray(entry.value, dtype=float).reshape(-1)
        if values.size != len(parameters):
            raise EffectError(
                f"effect {applied.kind!r} has {values.size} values and the capture has {len(parameters)} states"
            )
    else:
        missing = [p.name for p in parameters if p.name not in applied.parameters]
        if missing:
            raise EffectError(f"effect {applied.kind!r} lacks: {', '.join(missing)}")
        values = np.array([applied.parameters[p.name].value for p in parameters], dtype=float)
    effect.apply(changes, model, place, values)


def changes_of(model: InstrumentModel, conditions: Conditions, capture: str | None = None) -> Changes:
    """What the instrument's effects change; those of scope "capture" only if `capture` is among their captures."""
    changes = Changes(conditions)
    for applied in model.effects:
        if applied.scope == "instrument" or (capture is not None and capture in applied.captures):
            apply_to(changes, model, applied)
    return changes


def turned_by(model: InstrumentModel, axis: str) -> Mapping[str, float]:
    """Ratio of each element that the axis turns."""
    return {e.name: e.ratio for e in model.elements() if e.axis == axis}


def moving_axes(model: InstrumentModel, conditions: Conditions) -> tuple[str, ...]:
    """Axes that turn an element and take at least three different angles."""
    return tuple(a for a in model.axes if np.unique(np.round(conditions.angles_deg[a], 3)).size >= 3)


def retarders(model: InstrumentModel, train: Literal["generator", "analyzer"]) -> tuple[str, ...]:
    """Names of the retarders of a train."""
    return tuple(e.name for e in getattr(model, train) if isinstance(e, Retarder))


def turns(model: InstrumentModel, conditions: Conditions, element: str) -> tuple[Array, ...]:
    """cos and sin of once, then of twice the angle through which the element turned, each (N,)."""
    found = next(e for e in model.elements() if e.name == element)
    t = np.deg2rad(found.ratio * conditions.angles_deg[found.axis or ""])
    return np.cos(t), np.sin(t), np.cos(2 * t), np.sin(2 * t)
