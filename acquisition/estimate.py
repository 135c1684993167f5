"""How long a capture will take, from distances, speeds and exposures."""

from __future__ import annotations

from acquisition.job import Job
from acquisition.rig import Rig

#: Seconds that a frame takes to arrive and be written, where nothing overlaps it.
FRAME_S = 0.05


def capture_seconds(job: Job, rig: Rig) -> float:
    """Seconds for all states, without homing and the way to the first state."""
    table = job.table
    seconds = 0.0
    for k in range(len(table)):
        longest = 0.0
        for axis, column in table.angles_deg.items():
            distance = float(column[k] - column[k - 1]) if k else 0.0
            if distance:
                longest = max(longest, rig.axes[axis].move_time_s(distance))
        moved = longest > 0
        seconds += longest / rig.time_scale + (job.rig.settle_s if moved else 0.0)
        seconds += float(table.exposure_s[k] * table.repeats[k]) + FRAME_S
    return seconds
