"""Whether solids keep their distance along the whole of a move, not only at its ends.

All that turns here turns about one vertical, so the distance of two solids depends on one angle alone: by how much one
is turned against the other. A turn by d radians brings no point of a solid nearer by more than d times its reach, its
largest distance from the vertical. So from a pose with room to spare the angle may go on by that room divided by the
reach without another look (conservative advancement: Mirtich, "Impulse-based dynamic simulation of rigid body
systems", 1996, section 2.3); nothing between two looks can be missed.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from acquisition.rig.solids import Box, Cylinder, Solid, Solids

#: Added to the margin, so that the search ends.
RESOLUTION_MM = 0.5

Ranges = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Footprint:
    """A solid seen from above: a convex polygon, or a point, grown by a radius; and the heights it spans."""

    corners_mm: NDArray[np.float64]
    radius_mm: float
    low_mm: float
    high_mm: float

    @property
    def reach_mm(self) -> float:
        """Largest distance of any of its points from the vertical through the origin."""
        return float(np.hypot(*self.corners_mm.T).max()) + self.radius_mm

    def turned(self, angle_deg: float) -> "Footprint":
        """The same, turned from +z towards +x."""
        c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
        x, z = self.corners_mm.T
        turned = np.stack([c * x + s * z, c * z - s * x], axis=1)
        return Footprint(turned, self.radius_mm, self.low_mm, self.high_mm)


@dataclass(frozen=True)
class Clash:
    """Two solids that a move brings nearer than the margin, and the angle between them where it does."""

    first: Solid
    second: Solid
    angle_deg: float


def find_clash(solids: Solids, ranges_deg: Ranges) -> Clash | None:
    """The first two solids that come too near while axes are anywhere in their ranges, or None.

    Axes run at the same time at their own speeds, so any combination of angles counts as passed. An axis without a
    range may be anywhere.
    """
    for first, second in _pairs(solids):
        (low_1, high_1), (low_2, high_2) = (_range_of(solid, ranges_deg) for solid in (first, second))
        angle_deg = _first_clash_deg(first, second, low_1 - high_2, high_1 - low_2, margin_mm=solids.margin_mm)
        if angle_deg is not None:
            return Clash(first, second, angle_deg)
    return None


def describe(clash: Clash, margin_mm: float) -> str:
    """The clash in words."""
    first, second = clash.first, clash.second
    if first.turns_with and second.turns_with:
        angle = f"{first.turns_with} minus {second.turns_with} = {clash.angle_deg:.2f} deg"
    else:
        sign = 1 if first.turns_with else -1
        angle = f"{first.turns_with or second.turns_with} at {sign * clash.angle_deg:.2f} deg"
    return f"solids {first.name!r} and {second.name!r} nearer than {margin_mm:g} mm, {angle}"


def _pairs(solids: Solids) -> Iterator[tuple[Solid, Solid]]:
    for first, second in combinations(solids.parts, 2):
        # What hangs on the same axis, or stands still both, is bolted together.
        if first.turns_with != second.turns_with:
            yield first, second


def _range_of(solid: Solid, ranges_deg: Ranges) -> tuple[float, float]:
    if solid.turns_with is None:
        return 0.0, 0.0
    return ranges_deg.get(solid.turns_with, (-math.inf, math.inf))


@cache
def _first_clash_deg(first: Solid, second: Solid, low_deg: float, high_deg: float, *, margin_mm: float) -> float | None:
    a, b = footprint(first), footprint(second)
    if max(a.low_mm, b.low_mm) - min(a.high_mm, b.high_mm) >= margin_mm:
        return None
    if not high_deg - low_deg < 360.0:
        low_deg, high_deg = -180.0, 180.0
    reach_mm = min(a.reach_mm, b.reach_mm)
    angle_deg = low_deg
    while True:
        room_mm = gap_mm(a.turned(angle_deg), b) - margin_mm
        if room_mm <= RESOLUTION_MM:
            return angle_deg
        if angle_deg >= high_deg:
            return None
        angle_deg = min(high_deg, angle_deg + math.degrees(room_mm / reach_mm))


def footprint(solid: Solid) -> Footprint:
    """The solid seen from above, at the angle 0 of its axis."""
    x, y, z = solid.centre_mm
    if isinstance(solid, Cylinder):
        half = solid.height_mm / 2
        return Footprint(np.array([[x, z]]), solid.radius_mm, y - half, y + half)
    if isinstance(solid, Box):
        width, height, depth = (size / 2 for size in solid.size_mm)
    else:
        width, height, depth = solid.radius_mm, solid.radius_mm, solid.thickness_mm / 2
    corners = np.array([[-width, -depth], [width, -depth], [width, depth], [-width, depth]])
    corners += (x, z)
    return Footprint(corners, 0.0, y - height, y + height)


def gap_mm(a: Footprint, b: Footprint) -> float:
    """Horizontal distance of two footprints, 0 where they overlap."""
    if _overlap(a.corners_mm, b.corners_mm):
        return 0.0
    nearest = min(_distance_to_edges(a.corners_mm, b.corners_mm), _distance_to_edges(b.corners_mm, a.corners_mm))
    return max(0.0, nearest - a.radius_mm - b.radius_mm)


def _overlap(p: NDArray[np.float64], q: NDArray[np.float64]) -> bool:
    """Whether two convex polygons overlap: no edge of either separates them."""
    polygons = [polygon for polygon in (p, q) if len(polygon) > 2]
    for polygon in polygons:
        normals = (np.roll(polygon, -1, axis=0) - polygon) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        along_p, along_q = normals @ p.T, normals @ q.T
        is_separated = (along_p.max(axis=1) < along_q.min(axis=1)) | (along_q.max(axis=1) < along_p.min(axis=1))
        if is_separated.any():
            return False
    return bool(polygons)


def _distance_to_edges(points: NDArray[np.float64], polygon: NDArray[np.float64]) -> float:
    """Smallest distance of any of the points from any edge of the polygon, or from its one point."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    to_point = points[:, np.newaxis] - polygon
    length2 = np.maximum((edge**2).sum(axis=1), np.finfo(float).tiny)
    along = np.clip((to_point * edge).sum(axis=2) / length2, 0.0, 1.0)
    return float(np.linalg.norm(to_point - along[..., np.newaxis] * edge, axis=2).min())
