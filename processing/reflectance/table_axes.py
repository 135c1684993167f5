"""Bins of a table over (theta_h, theta_d, phi_d): 91 x 91 x 361, in one of two layouts (docs/conventions.md)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.compiling import compiled
from processing.computing.threads import for_ranges
from processing.geometry.rusinkiewicz import Angles

Layout = Literal["degree", "renderer"]
SHAPE = (91, 91, 361)


@dataclass(frozen=True)
class TableAxes:
    """Axis values of a layout.

    "degree" has steps of 1 degree on every axis, as Jarecki and Kupinski say; "renderer" has theta_h = 90 (i/90)^2
    degrees, i = 0..90, dense near specular, as the renderer's file and the lab's published script.
    The last phi_d is the first one again: both are stored as the first.
    """

    layout: Layout = "degree"

    @property
    def theta_h_deg(self) -> NDArray[np.float64]:
        """(91,), degrees."""
        i = np.arange(91.0)
        return i if self.layout == "degree" else 90 * (i / 90) ** 2

    @property
    def theta_d_deg(self) -> NDArray[np.float64]:
        """(91,), degrees."""
        return np.arange(91.0)

    @property
    def phi_d_deg(self) -> NDArray[np.float64]:
        """(361,), degrees."""
        return np.arange(-180.0, 181.0)

    def bins(self, angles: Angles, out: NDArray[np.int32] | None = None) -> NDArray[np.int32]:
        """Bin (...) of each direction, counted in C order over (theta_h, theta_d, phi_d); -1 for NaN.

        `out` (N,) is filled and returned in the shape of the angles where it has their size.
        """
        th, td, pd = (np.ascontiguousarray(v, dtype=np.float64).reshape(-1) for v in angles)
        if out is None or out.size != th.size:
            out = np.empty(th.size, dtype=np.int32)
        renderer = self.layout == "renderer"
        for_ranges(th.size, lambda start, stop: _bins(th, td, pd, renderer, out, start, stop))
        return out.reshape(np.shape(angles.theta_h))

    def angles(self, bins: NDArray[np.integer]) -> Angles:
        """Centres of bins (...), radians."""
        i, j, k = np.unravel_index(bins, SHAPE)
        return Angles(*(np.deg2rad(v) for v in (self.theta_h_deg[i], self.theta_d_deg[j], self.phi_d_deg[k])))


def _bins_at_once(
    th: Array, td: Array, pd: Array, renderer: bool, out: NDArray[np.int32], start: int, stop: int
) -> None:
    th, td, pd = (np.rad2deg(v[start:stop]) for v in (th, td, pd))
    with np.errstate(invalid="ignore"):
        axes = [np.minimum(np.rint(v), 90) for v in (90 * np.sqrt(th / 90) if renderer else th, td)]
        bins = (axes[0] * 91 + axes[1]) * 361 + (np.rint(pd) + 180) % 360
        out[start:stop] = np.where(np.isfinite(th + td + pd), bins, -1)


@compiled(_bins_at_once)
def _bins(th, td, pd, renderer, out, start, stop):  # type: ignore[no-untyped-def]
    degree = 180.0 / np.pi
    for n in range(start, stop):
        if not (np.isfinite(th[n]) and np.isfinite(td[n]) and np.isfinite(pd[n])):
            out[n] = -1
            continue
        i = int(np.rint(90.0 * np.sqrt(th[n] * 2.0 / np.pi))) if renderer else int(np.rint(th[n] * degree))
        j = int(np.rint(td[n] * degree))
        k = int(np.rint(pd[n] * degree)) + 180
        out[n] = (min(i, 90) * 91 + min(j, 90)) * 361 + (0 if k == 360 else k)
