"""A sphere in front of a pinhole camera: which pixels see it, and the normal there."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from processing.arrays import Array
from processing.section import Section


class Sphere(Section):
    """A sphere of known radius; `centre_mm` is its offset from the centre of rotation."""

    kind: Literal["sphere"] = "sphere"
    radius_mm: float = Field(gt=0, description="radius, mm")
    centre_mm: tuple[float, float, float] = Field(
        default=(0.0, 0.0, 0.0), description="centre from the centre of rotation, mm"
    )

    def intersect(self, origin_mm: Array, rays: Array, omega_deg: float) -> tuple[NDArray[np.bool_], Array, Array]:
        """Nearest hits of rays (..., 3): mask (...), points (N, 3) in mm and outward normals (N, 3)."""
        del omega_deg  # a sphere at the centre looks the same at any arm angle
        centre = np.asarray(self.centre_mm)
        to_centre = centre - np.asarray(origin_mm)
        along = rays @ to_centre
        gap = along * along - (to_centre @ to_centre - self.radius_mm**2)
        hit = (gap > 0) & (along > 0)
        t = along[hit] - np.sqrt(gap[hit])
        points = np.asarray(origin_mm) + rays[hit] * t[:, None]
        return hit, points, (points - centre) / self.radius_mm

    def occluded(self, points_mm: Array, towards: Array) -> NDArray[np.bool_]:
        """No point on the lit side is shaded by the shape itself: (N,) of False."""
        del towards
        return np.zeros(len(points_mm), dtype=bool)
