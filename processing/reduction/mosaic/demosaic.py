"""Demosaicing: from one mosaic frame to an image for each channel, by a method of the folder `methods` or a plug-in.

Every method maps a float32 frame (rows, columns) to (channels, rows, columns), whatever the bit depth it came from;
`superpixel` gives half the size. docs/mosaic.md compares them on scenes with a known truth.
"""

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.reduction.mosaic import methods
from processing.reduction.mosaic.layout import MosaicError, MosaicLayout

GROUP = "umov.demosaicing"


@dataclass(frozen=True)
class DemosaicingMethod:
    """One demosaicing method.

    Attributes
    ----------
    name : as in commands and lists.
    channels : of a float32 frame (rows, columns), images (channels, rows, columns) float32.
    reach : pixels from which a value is taken lie within this distance; next to an edge they mix both sides.
    linear : the weights of the raw pixels do not depend on the frame.
    covariance : of S, as `noise.stokes_covariance`; None: from the method itself.
    """

    name: str
    channels: Callable[[Image, MosaicLayout], NDArray[np.float32]]
    reach: int
    linear: bool
    covariance: Callable[..., NDArray[np.float32]] | None


@cache
def demosaicing_methods() -> dict[str, DemosaicingMethod]:
    """Every method by name, in alphabetical order.

    Raises MosaicError: a file lacks a part, or a plug-in offers a name that exists already.
    """
    found = {}
    for info in pkgutil.iter_modules(methods.__path__):
        name = info.name.replace("_", "-")
        found[name] = _method(name, importlib.import_module(f"{methods.__name__}.{info.name}"))
    for entry in entry_points(group=GROUP):
        if entry.name in found:
            raise MosaicError(f"plug-in {entry.value} offers the method {entry.name!r}, which exists already")
        found[entry.name] = _method(entry.name, entry.load())
    return dict(sorted(found.items()))


def _method(name: str, module: ModuleType) -> DemosaicingMethod:
    if not module.__doc__ or not hasattr(module, "channels") or not hasattr(module, "REACH"):
        raise MosaicError(
            f"{module.__name__} is no demosaicing method: it needs a docstring, REACH and channels(frame, layout)"
        )
    linear, covariance = getattr(module, "LINEAR", False), getattr(module, "covariance", None)
    return DemosaicingMethod(name, module.channels, module.REACH, linear, covariance)


def method_of(name: str) -> DemosaicingMethod:
    """The method of this name. Raises MosaicError with the names that exist."""
    known = demosaicing_methods()
    if name not in known:
        raise MosaicError(f"demosaicing method {name!r} is none of {', '.join(known)}")
    return known[name]


def demosaic(frame: NDArray[np.generic], layout: MosaicLayout, method: str) -> NDArray[np.float32]:
    """Channels of one mosaic frame by a named method.

    Parameters
    ----------
    frame : (rows, columns), integers of any depth or floating.
    method : a key of `demosaicing_methods`.

    Raises
    ------
    MosaicError : unknown method, or a frame that does not hold whole super-pixels.
    """
    chosen = method_of(method)
    layout.check((frame.shape[0], frame.shape[1]))
    return chosen.channels(np.ascontiguousarray(frame, dtype=np.float32), layout)
