"""Effects of the reflectance, and the families that the diagnosis asks for: they bend the dominant process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cache
from typing import ClassVar

from processing.arrays import Array
from processing.effect import Effect, Parameter, found_in
from processing.geometry.viewing import ViewingGeometry
from processing.reflectance.changes import ReflectanceChanges

#: Entry points of packages outside that add effects.
ENTRY_POINTS = "umov.reflectance_effects"


class ReflectanceEffect(Effect, ABC):
    """One thing that the model of a surface can lack.

    Attributes
    ----------
    rough : part of what it explains (chi-square) that its simple form may leave over; beside it no effect is named
        that explains less.
    advice : the one look or capture that shows it, if there is one, in a sentence.
    """

    rough: ClassVar[float] = 1e-3
    advice: ClassVar[str] = ""

    def places_on(self, shape: str) -> Sequence[str]:
        """Where it can act on an object in front of a camera: `shape` is "sphere", "flat" or "mesh"."""
        return ("",)

    @abstractmethod
    def parameters(self, place: str) -> tuple[Parameter, ...]:
        """The parameters at a place."""

    @abstractmethod
    def bend(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        """Add the effect of `values` to the changes."""


class BentValley(ReflectanceEffect):
    """Its values trade off along a bent valley: curvature at one point tells neither minimum nor error."""


class MaterialEffect(ReflectanceEffect):
    """Corrected in the material file."""

    @abstractmethod
    def physical(self, parameters: tuple[Parameter, ...], index: complex, a: float) -> tuple[Parameter, ...]:
        """The parameters, bounded by what a material of this index and diffuse weight allows."""


class GeometryEffect(ReflectanceEffect):
    """Corrected in the geometry file."""

    @abstractmethod
    def corrected(self, view: ViewingGeometry, values: dict[str, float]) -> ViewingGeometry:
        """The geometry with the values found, by name of the parameter."""


@cache
def reflectance_effects() -> dict[str, ReflectanceEffect]:
    """Effects of the reflectance by kind: the files of the folder, then plug-ins."""
    return found_in("processing.reflectance.effects", ReflectanceEffect, ENTRY_POINTS)  # type: ignore[type-abstract]
