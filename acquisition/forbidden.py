"""Poses that the rig must neither stand in nor pass on the way."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from acquisition.rig_config import ForbiddenPose


def find_forbidden(
    boxes: Iterable[ForbiddenPose], start_deg: Mapping[str, float], end_deg: Mapping[str, float]
) -> ForbiddenPose | None:
    """The first box that a move may enter, or None.

    Axes run at the same time at their own speeds, so any combination of angles between start and end counts as
    passed: the box that start and end span must not touch a forbidden one. An axis that neither mapping has is
    taken to be anywhere.
    """
    for box in boxes:
        touched = True
        for axis, (low, high) in box.ranges_deg.items():
            ends = [angles[axis] for angles in (start_deg, end_deg) if axis in angles]
            if ends and (max(ends) < low or min(ends) > high):
                touched = False
                break
        if touched:
            return box
    return None


def describe(box: ForbiddenPose) -> str:
    """The box in words."""
    ranges = ", ".join(f"{axis} {low:g} to {high:g} deg" for axis, (low, high) in box.ranges_deg.items())
    return f"forbidden pose ({ranges}): {box.why}"
