"""Rotators that may go on to the next turn instead of unwinding between captures."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from acquisition.rig.rig import Rig
from processing.instrument.states import StateTable

#: An endless axis unwinds once it has come this far: position counters are not endless.
UP_TO_DEG = 36_000.0


def unwound(table: StateTable, rig: Rig) -> StateTable:
    """The table with its endless axes moved on by whole turns, so that the first state lies ahead of where they stand.

    They come to every state from below then, and never turn back the way they came.
    """
    angles = dict(table.angles_deg)
    for name in rig.config.endless:
        axis = rig.axes[name]
        free = axis.limits.min_deg is None and axis.limits.max_deg is None
        if free and name in angles and np.ptp(angles[name]) > 0 and axis.is_homed():
            here = axis.read_position().deg
            turns = math.ceil((here - 1e-3 - float(angles[name].min())) / 360.0)
            if turns > 0 and here < UP_TO_DEG:
                angles[name] = angles[name] + 360.0 * turns
    return replace(table, angles_deg=angles)
