"""A flat sample, turned about the vertical axis of the centre of rotation."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from processing.arrays import Array
from processing.section import Section


class Flat(Section):
    """A rectangle through the centre of rotation.

    `normal_deg` is the azimuth of its normal from the camera's axis, positive towards the source;
    None lets it follow the arm and bisect source and camera (the specular pose).
    """

    kind: Literal["flat"] = "flat"
    width_mm: float = Field(gt=0, description="width, mm")
    height_mm: float = Field(gt=0, description="height, mm")
    normal_deg: float | None = Field(default=None, description="direction of the normal, degrees")

    def intersect(self, origin_mm: Array, rays: Array, omega_deg: float) -> tuple[NDArray[np.bool_], Array, Array]:
        """Hits of rays (..., 3): mask (...), points (N, 3) in mm and normals (N, 3)."""
        turn = np.deg2rad(omega_deg / 2 if self.normal_deg is None else self.normal_deg)
        normal = np.array([np.sin(turn), 0.0, np.cos(turn)])
        across = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        facing = -(rays @ normal)
        depth = float(np.asarray(origin_mm) @ normal)
        t = np.divide(depth, facing, out=np.full(facing.shape, np.inf), where=facing > 1e-9)
        points = np.asarray(origin_mm) + rays * np.where(np.isfinite(t), t, 0.0)[..., None]
        hit = (
            np.isfinite(t)
            & (t > 0)
            & (np.abs(points @ across) <= self.width_mm / 2)
            & (np.abs(points[..., 1]) <= self.height_mm / 2)
        )
        inside = points[hit]
        return hit, inside, np.broadcast_to(normal, inside.shape).copy()

    def occluded(self, points_mm: Array, towards: Array) -> NDArray[np.bool_]:
        """No point on the lit side is shaded by the shape itself: (N,) of False."""
        del towards
        return np.zeros(len(points_mm), dtype=bool)
