"""Poses that the rig must neither stand in nor pass on the way."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from acquisition.rig.config import ForbiddenPose


def find_forbidden(
    boxes: Iterable[ForbiddenPose], start_deg: Mapping[str, float], end_deg: Mapping[str, float]
) -> ForbiddenPose | None:
    """The first box that a move may enter, or None.

    Axes run at the same time at their own speeds, so any combination of angles between start and end counts as
    passed: the box that start and end span must not touch a forbidden one. An axis that neither mapping has is
    taken to be anywhere. A rig that stands in a forbidden box, for instance after homing, may leave it.
    """
    for box in boxes:
        if _inside(box, end_deg) or (_touches(box, start_deg, end_deg) and not _inside(box, start_deg)):
            return box
    return None


def describe(box: ForbiddenPose) -> str:
    """The box in words."""
    ranges = ", ".join(f"{axis} {low:g} to {high:g} deg" for axis, (low, high) in box.ranges_deg.items())
    return f"forbidden pose ({ranges}): {box.why}"


def _inside(box: ForbiddenPose, angles_deg: Mapping[str, float]) -> bool:
    return all(axis in angles_deg and low <= angles_deg[axis] <= high for axis, (low, high) in box.ranges_deg.items())


def _touches(box: ForbiddenPose, start_deg: Mapping[str, float], end_deg: Mapping[str, float]) -> bool:
    for axis, (low, high) in box.ranges_deg.items():
        ends = [angles[axis] for angles in (start_deg, end_deg) if axis in angles]
        if ends and (max(ends) < low or min(ends) > high):
            return False
    return True
