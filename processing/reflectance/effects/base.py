"""What effects of the reflectance model share: they bend the dominant process and have no place in an instrument."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import cache
from typing import ClassVar

from processing.arrays import Array
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import Effect, EffectError, effects_in
from processing.instrument.model import InstrumentModel
from processing.reflectance.changes import ReflectanceChanges


class ReflectanceEffect(Effect):
    """An effect of the paper's model in place of the instrument's.

    Attributes
    ----------
    rough : part of what it explains (chi-square) that its simple form may leave over; beside it no effect is named
        that explains less.
    bent : its values trade off along a bent valley, so that curvature at one point tells neither minimum nor error.
    """

    group = "reflectance"
    rough: ClassVar[float] = 1e-3
    bent: ClassVar[bool] = False

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ()

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        raise EffectError(f"effect {self.kind!r} belongs to a reflectance model, not to an instrument file")

    def places_on(self, shape: str) -> Sequence[str]:
        """Where it can act on an object in front of a camera: `shape` is "sphere", "flat" or "mesh"."""
        return ("",)

    def bend_at(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        """`bend`, for an effect that has more than one place."""
        self.bend(changes, values)

    @abstractmethod
    def bend(self, changes: ReflectanceChanges, values: Array) -> None:
        """Add the effect of `values` to the changes."""


@cache
def reflectance_effects() -> dict[str, ReflectanceEffect]:
    """Effects of the reflectance by kind: each module of this folder that has a class `This`."""
    found = effects_in("processing.reflectance.effects")
    return {kind: effect for kind, effect in found.items() if isinstance(effect, ReflectanceEffect)}
