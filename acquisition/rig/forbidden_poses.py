"""Poses that the rig must neither stand in nor pass on the way."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from acquisition.rig.parts import ForbiddenPose


def find_forbidden(
    boxes: Iterable[ForbiddenPose], start_deg: Mapping[str, float], end_deg: Mapping[str, float]
) -> ForbiddenPose | None:
    """The first box that a move may enter, or None.

    Axes run at the same time at their own speeds, so any combination of angles between start and end counts as
    passed: the box that start and end span must not touch a forbidden one. An axis that neither mapping has is
    taken to be anywhere. A rig that stands in a forbidden box, for instance after homing, may leave it.
    """
    ranges = spanned(start_deg, end_deg)
    for box in boxes:
        if _inside(box, end_deg) or (touches(box, ranges) and not _inside(box, start_deg)):
            return box
    return None


def spanned(start_deg: Mapping[str, float], end_deg: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Lowest and highest angle of each axis during a move; an axis that only one mapping has stands there."""
    ranges = {}
    for axis in start_deg.keys() | end_deg.keys():
        ends = [angles[axis] for angles in (start_deg, end_deg) if axis in angles]
        ranges[axis] = (min(ends), max(ends))
    return ranges


def touches(box: ForbiddenPose, ranges_deg: Mapping[str, tuple[float, float]]) -> bool:
    """Whether the box can be met while axes are anywhere in their ranges; one without a range may be anywhere."""
    return all(
        axis not in ranges_deg or (ranges_deg[axis][1] >= low and ranges_deg[axis][0] <= high)
        for axis, (low, high) in box.ranges_deg.items()
    )


def describe(box: ForbiddenPose) -> str:
    """The box in words."""
    ranges = ", ".join(f"{axis} {low:g} to {high:g} deg" for axis, (low, high) in box.ranges_deg.items())
    return f"a forbidden pose ({ranges}): {box.why}"


def _inside(box: ForbiddenPose, angles_deg: Mapping[str, float]) -> bool:
    return all(axis in angles_deg and low <= angles_deg[axis] <= high for axis, (low, high) in box.ranges_deg.items())
