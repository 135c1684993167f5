"""What effects of an instrument and of a reflectance share: a kind, parameters, and how their files are found."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import TypeVar

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
    """One thing that a model can lack. Its `kind` is the name of its file, whose docstring says cause and mending."""

    kind: str = ""


E = TypeVar("E", bound=Effect)


def found_in(package: str, family: type[E], group: str) -> dict[str, E]:
    """Effects by kind: one concrete class in each module of a package, then plug-ins of an entry point group.

    Raises
    ------
    EffectError : a module defines no effect of the family, or more than one; a plug-in offers one that exists.
    """
    found: dict[str, E] = {}
    for info in sorted(pkgutil.iter_modules(importlib.import_module(package).__path__), key=lambda i: i.name):
        if info.name != BASE and not info.name.startswith("_"):
            found[info.name] = _only_effect(f"{package}.{info.name}", family)()
    for entry in entry_points(group=group):
        if entry.name in found:
            raise EffectError(f"plug-in {entry.value} offers the effect {entry.name!r}, which exists already")
        found[entry.name] = entry.load()()
    for kind, effect in found.items():
        effect.kind = kind
    return found


def _only_effect(module: str, family: type[E]) -> type[E]:
    classes = inspect.getmembers(importlib.import_module(module), inspect.isclass)
    own = [c for _, c in classes if c.__module__ == module and issubclass(c, family) and not inspect.isabstract(c)]
    if len(own) != 1:
        names = ", ".join(c.__name__ for c in own) or "none"
        raise EffectError(f"{module} has to define one {family.__name__}; it defines {names}")
    return own[0]
