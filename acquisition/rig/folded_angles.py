"""Targets outside an axis's travel, moved into it by whole half turns or turns, which its element does not notice."""

import math
from dataclasses import replace

import numpy as np

from acquisition.rig.rig import Rig
from drivers.axis_types import Limits
from processing.instrument.states import StateTable


def fold_angles(table: StateTable, rig: Rig) -> StateTable:
    """The table with the targets of every axis in `fold_deg` inside its limits, each as near to the last as can be.

    A column that is inside already, or that no multiple brings inside, stays as it is.
    """
    angles = dict(table.angles_deg)
    for name, period_deg in rig.config.fold_deg.items():
        if name in angles:
            angles[name] = _fold_column(angles[name], rig.axes[name].limits, float(period_deg))
    return replace(table, angles_deg=angles)


def _fold_column(column: np.ndarray, limits: Limits, period_deg: float) -> np.ndarray:
    low = -math.inf if limits.min_deg is None else limits.min_deg
    high = math.inf if limits.max_deg is None else limits.max_deg
    if np.all((low <= column) & (column <= high)):
        return column
    targets = np.empty_like(column)
    last_deg = (low + high) / 2 if math.isfinite(low + high) else float(column[0])
    for k, angle in enumerate(column):
        nearest = angle + period_deg * round((last_deg - angle) / period_deg)
        inside = [a for a in (nearest, nearest - period_deg, nearest + period_deg) if low <= a <= high]
        if not inside:
            return column
        targets[k] = last_deg = min(inside, key=lambda a: abs(a - last_deg))
    return targets
