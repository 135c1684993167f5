"""Poses that the rig must neither stand in nor pass on the way. Every angle counts modulo a turn."""

import math
from collections.abc import Iterable, Mapping

from acquisition.rig.parts import ForbiddenPose
from drivers.axis_types import Limits

TURN_DEG = 360.0
#: A reading differs from its target by this much: a position that lies so near to an edge counts as on its outer side.
EDGE_DEG = 0.05


def find_forbidden(
    boxes: Iterable[ForbiddenPose],
    start_deg: Mapping[str, float],
    end_deg: Mapping[str, float],
    limits: Mapping[str, Limits] | None = None,
) -> ForbiddenPose | None:
    """The first box that a move may enter, or None.

    Axes run at the same time at their own speeds, so any combination of angles between start and end counts as
    passed: the box that start and end span must not touch a forbidden one. An axis that neither mapping has is
    taken to be anywhere. A rig that stands in a forbidden box, for instance after homing, may leave it with one axis
    at a time, by the nearer of the two edges that the limits of this axis let it reach.
    """
    ranges = swept_ranges(start_deg, end_deg)
    for box in boxes:
        if _inside(box, end_deg) or (touches(box, ranges) and not _leaves(box, start_deg, end_deg, limits or {})):
            return box
    return None


def swept_ranges(start_deg: Mapping[str, float], end_deg: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Lowest and highest angle of each axis during a move; an axis that only one mapping has stands there."""
    ranges = {}
    for axis in start_deg.keys() | end_deg.keys():
        ends = [angles[axis] for angles in (start_deg, end_deg) if axis in angles]
        ranges[axis] = (min(ends), max(ends))
    return ranges


def touches(box: ForbiddenPose, ranges_deg: Mapping[str, tuple[float, float]]) -> bool:
    """Whether the box can be met while axes are anywhere in their ranges; one without a range may be anywhere."""
    return all(axis not in ranges_deg or _meet(ranges_deg[axis], edges) for axis, edges in box.ranges_deg.items())


def describe(box: ForbiddenPose) -> str:
    """The box in words."""
    ranges = ", ".join(f"{axis} {low:g} to {high:g} deg" for axis, (low, high) in box.ranges_deg.items())
    return f"a forbidden pose ({ranges}): {box.why}"


def _meet(way: tuple[float, float], edges: tuple[float, float]) -> bool:
    """Whether a way has an angle in common with a range, in any turn."""
    if not way[1] - way[0] < TURN_DEG:
        return True
    low, high = _nearest_copy(edges, way[0])
    return low <= way[1] and way[0] <= high


def _nearest_copy(edges: tuple[float, float], angle_deg: float) -> tuple[float, float]:
    """The range moved by whole turns to the first place whose upper edge is not below the angle."""
    shift = TURN_DEG * math.ceil((angle_deg - edges[1]) / TURN_DEG)
    return edges[0] + shift, edges[1] + shift


def _inside(box: ForbiddenPose, angles_deg: Mapping[str, float]) -> bool:
    return all(
        axis in angles_deg and _meet((angles_deg[axis], angles_deg[axis]), edges)
        for axis, edges in box.ranges_deg.items()
    )


def _leaves(
    box: ForbiddenPose, start_deg: Mapping[str, float], end_deg: Mapping[str, float], limits: Mapping[str, Limits]
) -> bool:
    """Whether a move that begins in the box goes out of it the short way, and does not come back."""
    if not _inside(box, start_deg):
        return False
    outside = dict(start_deg)
    moving = [axis for axis in box.ranges_deg if abs(end_deg[axis] - start_deg[axis]) > EDGE_DEG]
    for axis in moving:
        start, is_upwards = start_deg[axis], end_deg[axis] > start_deg[axis]
        low, high = _nearest_copy(box.ranges_deg[axis], start)
        way, other_way = (high - start, start - low) if is_upwards else (start - low, high - start)
        shortest = way <= other_way + EDGE_DEG or not _can_reach(limits.get(axis), low if is_upwards else high)
        if way <= EDGE_DEG or (moving == [axis] and shortest):
            outside[axis] = math.nextafter(high, math.inf) if is_upwards else math.nextafter(low, -math.inf)
    return outside != start_deg and not touches(box, swept_ranges(outside, end_deg))


def _can_reach(limits: Limits | None, edge_deg: float) -> bool:
    """Whether an axis can go beyond an edge."""
    low, high = (None, None) if limits is None else (limits.min_deg, limits.max_deg)
    return (low is None or low < edge_deg) and (high is None or high > edge_deg)
