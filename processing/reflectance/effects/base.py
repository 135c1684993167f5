"""Effects of the reflectance: they bend the dominant process."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cache
from typing import ClassVar, Literal

from processing.arrays import Array
from processing.effect import Effect, Parameter, load_effects
from processing.geometry.viewing import ViewingGeometry
from processing.reflectance.changes import ReflectanceChanges

#: Entry points of packages outside that add effects.
ENTRY_POINTS = "umov.reflectance_effects"


class ReflectanceEffect(Effect, ABC):
    """One thing that the model of a surface can lack.

    `corrects` says in which file it is corrected. Beside it no effect is named that explains less than it leaves over.
    """

    corrects: ClassVar[Literal["", "material", "geometry"]] = ""
    #: Its parameters where they are the same at every place.
    fixed_parameters: ClassVar[tuple[Parameter, ...]] = ()
    rough = 1e-3

    def places_on(self, shape: str) -> Sequence[str]:
        """Where it can act on an object in front of a camera: `shape` is "sphere", "flat" or "mesh"."""
        return ("",)

    def parameters(self, place: str) -> tuple[Parameter, ...]:
        """The parameters at a place."""
        return self.fixed_parameters

    @abstractmethod
    def bend(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        """Add the effect of `values` to the changes."""

    def physical(self, parameters: tuple[Parameter, ...], index: complex, a: float) -> tuple[Parameter, ...]:
        """The parameters, bounded by what a material of this index and diffuse weight allows."""
        return parameters

    def corrected(self, view: ViewingGeometry, values: dict[str, float]) -> ViewingGeometry:
        """The geometry with the values found, by name of the parameter."""
        return view


@cache
def reflectance_effects() -> dict[str, ReflectanceEffect]:
    """Effects of the reflectance by kind: the files of the folder, then plug-ins."""
    return load_effects("processing.reflectance.effects", ReflectanceEffect, ENTRY_POINTS)  # type: ignore[type-abstract]
