"""How long a capture will take, from distances, speeds and exposures."""

from collections.abc import Mapping

from acquisition.capture.job import Job
from acquisition.rig.rig import Rig
from acquisition.rig.turns import fold_angles

#: Seconds that a frame takes to arrive and be written, where nothing overlaps it.
FRAME_S = 0.05


def capture_seconds(job: Job, rig: Rig, before_deg: Mapping[str, float] | None = None) -> float:
    """Seconds for the way from `before_deg` to the first state and for all states, without homing and people.

    An axis that may go on to the next turn is taken to go on by the shortest way up.
    """
    table = fold_angles(job.table, rig)
    first = {axis: float(column[0]) for axis, column in table.angles_deg.items()}
    start_deg = before_deg or {}
    seconds = sum(_move_s(rig, axis, angle - start_deg[axis]) for axis, angle in first.items() if axis in start_deg)
    for k in range(len(table)):
        longest = 0.0
        for axis, column in table.angles_deg.items():
            distance = float(column[k] - column[k - 1]) if k else 0.0
            if distance:
                longest = max(longest, rig.axes[axis].move_time_s(distance) / rig.time_scale)
        seconds += longest + (job.rig.settle_s if longest > 0 else 0.0)
        seconds += float(table.exposure_s[k] * table.repeats[k]) + FRAME_S
    return seconds


def last_pose_deg(job: Job) -> dict[str, float]:
    """Where the axes stand after the capture."""
    return {axis: float(column[-1]) for axis, column in job.table.angles_deg.items()}


def _move_s(rig: Rig, axis: str, distance_deg: float) -> float:
    if axis in rig.config.endless:
        distance_deg %= 360.0
    return rig.axes[axis].move_time_s(distance_deg) / rig.time_scale if distance_deg else 0.0
