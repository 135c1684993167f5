"""Obstacles of a move or of homing, and free ways: forbidden poses, and solids that come too near."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, TypeAlias

from acquisition.rig import clearance, forbidden_poses
from acquisition.rig.forbidden_poses import EDGE_DEG, find_forbidden, swept_ranges, touches
from drivers.axis_types import Limits

if TYPE_CHECKING:
    from acquisition.rig.sections import RigSections

ANYWHERE = (-math.inf, math.inf)
#: Axes that take part in a detour; the number of poses that it tries doubles with each.
MOST_AXES = 8

#: An angle of each axis, in degrees.
Pose: TypeAlias = Mapping[str, float]


def find_obstacle(
    rig: RigSections,
    start_deg: Pose,
    end_deg: Pose,
    moving: Iterable[str] | None = None,
    *,
    limits: Mapping[str, Limits] | None = None,
) -> str | None:
    """The first obstacle on the way of a move, in words; None if the way is free.

    Parameters
    ----------
    start_deg, end_deg : angles of the axes before and after; an axis in neither may be anywhere.
    moving : axes that move; what concerns none of them is not asked about. None for all.
    limits : of the axes; None for those of the rig file.
    """
    if limits is None:
        limits = {name: Limits(*axis.limits_deg) for name, axis in rig.axes.items() if axis and axis.limits_deg}
    names = None if moving is None else set(moving)
    boxes = [box for box in rig.forbidden if names is None or box.ranges_deg.keys() & names]
    box = find_forbidden(boxes, start_deg, end_deg, limits)
    if box is not None:
        return forbidden_poses.describe(box)
    carriers = _carriers(rig)
    if rig.solids is None or (names is not None and not carriers & names):
        return None
    clash = clearance.find_clash(rig.solids, swept_ranges(start_deg, end_deg))
    return None if clash is None else clearance.describe(clash, rig.solids.margin_mm)


def find_way(
    rig: RigSections,
    start_deg: Pose,
    target_deg: Pose,
    by: Sequence[Pose] = (),
    *,
    limits: Mapping[str, Limits] | None = None,
    first: str | None = None,
) -> list[dict[str, float]] | None:
    """The fewest moves that lead to a target without meeting anything, or None.

    Parameters
    ----------
    start_deg : where the axes stand; one that is not in it may be anywhere, or stands at its target.
    by : poses that a detour may lead through, as those of the states of a capture.
    limits : of the axes; None for those of the rig file.
    first : axis that goes first and alone where that way is free.

    Returns
    -------
    Targets of each move. In each, all axes start together. A detour leads through the poses of `by`, and through those
    in which some of the axes stand at their target and the others do not.
    """
    places = dict(target_deg) | dict(start_deg)
    if first is not None and first in target_deg and len(target_deg) > 1:
        first_move = {first: target_deg[first]}
        second_move = {name: angle for name, angle in target_deg.items() if name != first}
        legs = ((places, first_move), (places | first_move, second_move))
        if all(find_obstacle(rig, origin, origin | move, move, limits=limits) is None for origin, move in legs):
            return [first_move, second_move]
    axes = [name for name in restricted_axes(rig) if name in places]
    turning = [name for name in axes if abs(target_deg.get(name, places[name]) - places[name]) > EDGE_DEG]
    start = {name: places[name] for name in axes}
    end = start | {name: target_deg[name] for name in axes if name in target_deg}
    if len(turning) > MOST_AXES:
        turning = []
    corners = product(*((start[name], end[name]) for name in turning))
    nodes = [end, *(start | dict(zip(turning, corner, strict=True)) for corner in corners)]
    nodes += [start | {name: pose[name] for name in axes if name in pose} for pose in by]
    came_from: dict[int, int | None] = {}
    reached = deque[int]()

    def reach(from_node: int | None) -> None:
        origin = start if from_node is None else nodes[from_node]
        for node, pose in enumerate(nodes):
            if node not in came_from:
                moving = [name for name in axes if pose[name] != origin[name]]
                if find_obstacle(rig, origin, pose, moving, limits=limits) is None:
                    came_from[node] = from_node
                    reached.append(node)
                    if node == 0:
                        return

    reach(None)
    while reached and 0 not in came_from:
        reach(reached.popleft())
    if 0 not in came_from:
        return None
    poses, node = [end], came_from[0]
    while node is not None:
        poses.insert(0, nodes[node])
        node = came_from[node]
    detour = zip([start, *poses], poses[:-1], strict=False)
    moves = [{name: pose[name] for name in axes if pose[name] != before[name]} for before, pose in detour]
    return [*moves, dict(target_deg)]


def restricted_axes(rig: RigSections) -> set[str]:
    """Axes that forbidden poses or solids speak of."""
    return {axis for box in rig.forbidden for axis in box.ranges_deg} | _carriers(rig)


def find_homing_obstacle(rig: RigSections, names: Iterable[str], here_deg: Mapping[str, float]) -> str | None:
    """The first obstacle of axes that are homed one after another, in words; None if their way is free.

    Parameters
    ----------
    names : axes in the order in which they are homed.
    here_deg : where the axes that have a reference stand; the others may be anywhere.
    """
    # Limits of the rig file do not bind a controller that looks for its switch.
    ranges = {axis: (angle, angle) for axis, angle in here_deg.items()}
    for name in names:
        path = rig.homing.get(name)
        ways = ranges | {name: path.passes_deg if path else ANYWHERE}
        obstacle = _homing_obstacle(rig, name, ways)
        if obstacle is not None:
            hint = "" if path else f". If it cannot get there, say which angles it passes, in `homing: {{{name}: ...}}`"
            return f"homing {name} may meet {obstacle}{hint}"
        if path is not None:
            ranges[name] = (path.ends_deg, path.ends_deg)
        else:
            ranges.pop(name, None)
    return None


def _homing_obstacle(rig: RigSections, name: str, ways: Mapping[str, tuple[float, float]]) -> str | None:
    for box in rig.forbidden:
        if name in box.ranges_deg and not box.homing_may_pass and touches(box, ways):
            return forbidden_poses.describe(box)
    if rig.solids is None or name not in _carriers(rig):
        return None
    clash = clearance.find_clash(rig.solids, ways)
    return None if clash is None else clearance.describe(clash, rig.solids.margin_mm)


def _carriers(rig: RigSections) -> set[str]:
    return {solid.turns_with for solid in rig.solids.parts if solid.turns_with} if rig.solids else set()
