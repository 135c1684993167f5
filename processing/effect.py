"""Base of the effects of an instrument and of a reflectance: a kind, parameters, and how their files are found."""

import importlib
import inspect
import pkgutil
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import ClassVar, TypeVar

from processing.errors import ProcessError

#: The module of a folder that holds the families; modules with a leading underscore are helpers too.
BASE = "base"


class EffectError(ProcessError):
    """An effect does not exist, does not fit, or its file does not define exactly one."""


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


class Effect:
    """One thing that a model can lack. Its `kind` is the name of its file, whose docstring says cause and mending.

    What follows is what an effect declares of itself: the diagnosis asks for it, and never for a class.
    """

    kind: str = ""
    #: Parameter k acts on state k alone (which also makes its derivative cheap).
    per_state: ClassVar[bool] = False
    #: On or off: its parameter is not fitted.
    is_switch: ClassVar[bool] = False
    #: Would have other values in another capture of the same instrument.
    of_one_capture: bool = False
    #: Changes the light of the source, by the same share in the whole image.
    of_source: ClassVar[bool] = False
    #: Changes all channels of a state by one factor: a source whose level is free (`free_source`) takes it up.
    is_level: ClassVar[bool] = False
    #: Changes how bright the channels are against each other, and nothing of their polarization.
    of_channels: ClassVar[bool] = False
    #: A known surface shows it too.
    of_optics: ClassVar[bool] = False
    #: Varies over the image, so that every part of it has a W of its own.
    varies_over_image: ClassVar[bool] = False
    #: The curve from light to counts: a detector has one, whichever of these describes it.
    is_response: ClassVar[bool] = False
    #: A value of the train that the instrument file gives as only nominal: always fitted, and no fault.
    is_nominal: ClassVar[bool] = False
    #: A level of the source that each reduction projects out: always fitted, and no fault.
    is_projected: ClassVar[bool] = False
    #: Holds where an instrument file names it, and is not looked for: an unknown sample would take it up.
    from_file_only: ClassVar[bool] = False
    #: Its values trade off along a bent valley: slopes at zero tell little, so a search begins at its own minimum too.
    has_bent_valley: ClassVar[bool] = False
    #: Part of what it explains (chi-square) that its simple form may leave over.
    rough: ClassVar[float] = 0.0
    #: The one look or capture that shows it, if there is one, in a sentence.
    advice: ClassVar[str] = ""

    def moves_image(self, place: str) -> bool:
        """Whether it moves the image at this place, which is undone by moving the frames back."""
        return False

    def reaches_around(self, place: str) -> bool:
        """Whether it mixes a pixel with those around it at this place: the image is moved, or blurred."""
        return self.moves_image(place)

    def acts_on_counts(self, place: str) -> bool:
        """Whether it changes the counts at this place and not the rows of W: the image moves, the response bends."""
        return False

    def is_pointwise(self, place: str) -> bool:
        """Whether it changes every count by itself at this place, so that `undo` gives the counts of the light."""
        return False

    def slips(self, place: str) -> tuple[str, int] | None:
        """The axis that stands wrong at this place, and the state from which on; None if no axis does."""
        return None


E = TypeVar("E", bound=Effect)


def load_effects(package: str, family: type[E], group: str) -> dict[str, E]:
    """Effects by kind: one concrete class in each module of a package, then plug-ins of an entry point group.

    Raises EffectError: a module defines no effect of the family, or more than one; a plug-in offers one that exists.
    """
    effects: dict[str, E] = {}
    for info in sorted(pkgutil.iter_modules(importlib.import_module(package).__path__), key=lambda i: i.name):
        if info.name != BASE and not info.name.startswith("_"):
            effects[info.name] = _only_effect(f"{package}.{info.name}", family)()
    for entry in entry_points(group=group):
        if entry.name in effects:
            raise EffectError(f"plug-in {entry.value} offers the effect {entry.name!r}, which exists already")
        effects[entry.name] = entry.load()()
    for kind, effect in effects.items():
        effect.kind = kind
    return effects


def _only_effect(module: str, family: type[E]) -> type[E]:
    classes = inspect.getmembers(importlib.import_module(module), inspect.isclass)
    kinds = [c for _, c in classes if c.__module__ == module and issubclass(c, family) and not inspect.isabstract(c)]
    if len(kinds) != 1:
        names = ", ".join(c.__name__ for c in kinds) or "none"
        raise EffectError(f"{module} has to define one {family.__name__}; it defines {names}")
    return kinds[0]
