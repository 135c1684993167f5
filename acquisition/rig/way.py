"""What is in the way of a move or of homing: forbidden poses, and solids that would come too near."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from acquisition.rig import clearance, forbidden_poses
from acquisition.rig.forbidden_poses import find_forbidden, spanned, touches

if TYPE_CHECKING:
    from acquisition.rig.sections import RigSections

ANYWHERE = (-math.inf, math.inf)


def find_obstacle(
    rig: RigSections, start_deg: Mapping[str, float], end_deg: Mapping[str, float], moving: Iterable[str] | None = None
) -> str | None:
    """What a move meets anywhere on its way, in words; None if the way is free.

    Parameters
    ----------
    start_deg, end_deg : angles of the axes before and after; an axis in neither may be anywhere.
    moving : axes that move; what concerns none of them is not asked about. None for all.
    """
    names = None if moving is None else set(moving)
    boxes = [box for box in rig.forbidden if names is None or box.ranges_deg.keys() & names]
    box = find_forbidden(boxes, start_deg, end_deg)
    if box is not None:
        return forbidden_poses.describe(box)
    carriers = _carriers(rig)
    if rig.solids is None or (names is not None and not carriers & names):
        return None
    clash = clearance.find_clash(rig.solids, spanned(start_deg, end_deg))
    return None if clash is None else clearance.describe(clash, rig.solids.margin_mm)


def concerned(rig: RigSections) -> set[str]:
    """Axes that forbidden poses or solids speak of."""
    return {axis for box in rig.forbidden for axis in box.ranges_deg} | _carriers(rig)


def find_homing_obstacle(rig: RigSections, names: Iterable[str], here_deg: Mapping[str, float]) -> str | None:
    """What axes homed one after another could meet, in words; None if their way is free.

    Parameters
    ----------
    names : axes in the order in which they are homed.
    here_deg : where the axes that have a reference stand; the others may be anywhere.
    """
    # Limits of the rig file do not bind a controller that looks for its switch.
    here = {axis: (angle, angle) for axis, angle in here_deg.items()}
    for name in names:
        path = rig.homing.get(name)
        ways = here | {name: path.passes_deg if path else ANYWHERE}
        found = _met_homing(rig, name, ways)
        if found is not None:
            hint = "" if path else f". If it cannot get there, say which angles it passes, in `homing: {{{name}: ...}}`"
            return f"homing {name} may meet {found}{hint}"
        if path is not None:
            here[name] = (path.ends_deg, path.ends_deg)
        else:
            here.pop(name, None)
    return None


def _met_homing(rig: RigSections, name: str, ways: Mapping[str, tuple[float, float]]) -> str | None:
    for box in rig.forbidden:
        if name in box.ranges_deg and not box.homing_may_pass and touches(box, ways):
            return forbidden_poses.describe(box)
    if rig.solids is None or name not in _carriers(rig):
        return None
    clash = clearance.find_clash(rig.solids, ways)
    return None if clash is None else clearance.describe(clash, rig.solids.margin_mm)


def _carriers(rig: RigSections) -> set[str]:
    return {solid.turns_with for solid in rig.solids.parts if solid.turns_with} if rig.solids else set()
