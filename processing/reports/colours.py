"""Which colours a quantity is drawn in, on paper and on a screen: readable without red-green vision.

Signed quantities diverge about zero, red for positive and blue for negative everywhere; orientations run in a circle;
light is grey; standard errors have colours of their own, so that nobody takes one for the other.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

SIGNED = "RdBu_r"
CYCLIC = "twilight"
LIGHT = "gray"
ERROR = "magma"
PLAIN = "viridis"
ALL = (SIGNED, CYCLIC, LIGHT, ERROR, PLAIN)

#: Parts of names that tell what is drawn how; the first that fits decides.
_ORIENTATIONS = ("orientation", "aolp", "fast_axis", "axis_or_90")
_SIGNED = ("deviation", "circular", "docp", "vector", "s1", "s2", "mueller", "covariance")
_FLAGS = ("flags", "valid", "lit", "defined", "negative_determinant", "flip")
_LIGHT = ("s0", "m00")
#: Percentile of the values at which a scale ends.
END_PERCENT = 99.5


@dataclass(frozen=True)
class ColourScale:
    """Colours of a map and the values at their ends; what lies beyond an end is clipped."""

    colours: str
    low: float
    high: float


def period_deg(name: str, units: str) -> float | None:
    """After how many degrees an orientation is the same again; None for what is none."""
    if units != "degree" or name.endswith("_errors"):
        return None
    if "axis_or_90" in name:
        return 90.0
    return 180.0 if any(part in name for part in _ORIENTATIONS) else None


def colours_of(name: str, units: str) -> str:
    """Name of the colour map for a quantity of a product."""
    if name.endswith("_errors"):
        return ERROR
    if period_deg(name, units) is not None:
        return CYCLIC
    if any(name.endswith(part) or part in name.split("_") for part in (*_LIGHT, *_FLAGS)):
        return LIGHT
    if any(part in name.split("_") for part in _SIGNED):
        return SIGNED
    return PLAIN


def upper_end(values: NDArray[np.floating]) -> float:
    """Where the scale of a positive quantity ends: values far beyond the others, as at an object's limb, are clipped.

    The smaller of the 99.5th percentile and Tukey's outer fence, Q3 + 3 (Q3 - Q1). Where half of the values are equal
    the fence says nothing, and where none is finite the end is 1.

    Examples
    --------
    >>> upper_end(np.r_[np.linspace(0.1, 0.2, 97), [1.0, 1.1, 1.2]]) < 0.4
    True
    """
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 1.0
    first, third, end = (float(v) for v in np.percentile(finite, [25, 75, END_PERCENT]))
    return max(min(end, third + 3 * (third - first)) if third > first else end, 1e-30)


def scale_of(name: str, units: str, values: NDArray[np.floating]) -> ColourScale:
    """Colours and limits for a map: a period for orientations, symmetric about zero for signed quantities."""
    colours = colours_of(name, units)
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, [100 - END_PERCENT, END_PERCENT]) if finite.size else (0.0, 1.0)
    if (period := period_deg(name, units)) is not None:
        return ColourScale(colours, 0.0, period)
    if colours == SIGNED:
        most = max(abs(float(low)), abs(float(high)), 1e-6)
        return ColourScale(colours, -most, most)
    if colours in (LIGHT, ERROR):
        return ColourScale(colours, 0.0, max(float(high), 1e-6))
    return ColourScale(colours, float(low), max(upper_end(finite), float(low) + 1e-6))


@cache
def steps(colours: str, count: int = 33) -> tuple[tuple[float, str], ...]:
    """A colour map as (0 to 1, "#rrggbb") in equal steps, for a browser."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    drawn = colormaps[colours]
    return tuple((float(at), to_hex(drawn(at))) for at in np.linspace(0, 1, count))
