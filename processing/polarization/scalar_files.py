"""Finds the quantities that are one file each: `scalars/NAME.py`, and plug-ins of the entry point `umov.quantities`.

Such a module has `value(m)`, from Mueller matrices (..., 4, 4) to numbers (...), and the first line of its docstring is
what the map is called. Optional: `gradient(m)` (..., 16), else differences are taken; `UNITS`; `ELEMENTS`, the numbers
(row-major, m00 is 0) of the elements that are the vector whose length it is.
"""

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from types import ModuleType

import numpy as np

from processing.arrays import RealArray
from processing.errors import ProcessError
from processing.polarization import scalars
from processing.polarization.propagation import Derived, numeric_gradient

GROUP = "umov.quantities"


@dataclass(frozen=True)
class Scalar:
    """One number of a Mueller matrix.

    Attributes
    ----------
    name, title, units : as in products.
    value : from matrices (..., 4, 4) to (...).
    gradient : to (..., 16); None: by differences.
    elements : those of the vector whose length it is; empty: it is no length.
    """

    name: str
    title: str
    units: str
    value: Callable[[RealArray], RealArray]
    gradient: Callable[[RealArray], RealArray] | None
    elements: tuple[int, ...]

    def derived(self, m: RealArray) -> Derived:
        """Value and gradient of Mueller matrices (..., 4, 4)."""
        m = np.asarray(m, dtype=float)
        if self.gradient is not None:
            return Derived(self.value(m), self.gradient(m), self.elements)
        slope = numeric_gradient(lambda x: self.value(x)[..., None], m)[..., 0, :]
        return Derived(self.value(m), slope, self.elements)


@cache
def scalar_quantities() -> dict[str, Scalar]:
    """Every such quantity by name, in alphabetical order.

    Raises ProcessError: a file has no `value` or no docstring, or a plug-in offers a name that exists already.
    """
    names = (module.name for module in pkgutil.iter_modules(scalars.__path__))
    found = {name: read_scalar(name, importlib.import_module(f"{scalars.__name__}.{name}")) for name in names}
    for entry in entry_points(group=GROUP):
        if entry.name in found:
            raise ProcessError(f"plug-in {entry.value} offers the quantity {entry.name!r}, which exists already")
        found[entry.name] = read_scalar(entry.name, entry.load())
    return dict(sorted(found.items()))


def read_scalar(name: str, module: ModuleType) -> Scalar:
    """The quantity that a module defines. Raises ProcessError."""
    if not module.__doc__ or not hasattr(module, "value"):
        raise ProcessError(f"{module.__name__} is no quantity: it needs a docstring and a function value(m)")
    return Scalar(
        name,
        module.__doc__.splitlines()[0].rstrip("."),
        getattr(module, "UNITS", ""),
        module.value,
        getattr(module, "gradient", None),
        tuple(getattr(module, "ELEMENTS", ())),
    )
