"""Tables of states moved by turns: into the travel of an axis, and on to the next turn instead of unwinding.

A polarizer or retarder is the same after a half turn, so its targets are folded by half turns.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from acquisition.rig.rig import Rig
from acquisition.rig.way import find_way
from drivers.axis_types import Limits
from processing.instrument.states import StateTable

#: An endless axis unwinds once it has come this far: position counters are not endless.
UP_TO_DEG = 36_000.0


def fold_angles(table: StateTable, rig: Rig) -> StateTable:
    """The table with the targets of every axis in `fold_deg` inside its limits, each as near to the last as can be.

    A column that is inside already, or that no multiple brings inside, stays as it is.
    """
    angles = dict(table.angles_deg)
    for name, period_deg in rig.config.fold_deg.items():
        if name in angles:
            angles[name] = _fold_column(angles[name], rig.axes[name].limits, float(period_deg))
    return replace(table, angles_deg=angles)


def unwind(table: StateTable, rig: Rig, here_deg: Mapping[str, float] | None = None) -> StateTable:
    """The table with its endless axes moved by whole turns, so that the first state lies ahead of where they stand.

    They come to every state from below then, and never turn back the way they came. Where the way ahead is forbidden,
    they go to the first state by another turn.

    Parameters
    ----------
    here_deg : where the axes stand; None for where they stand once those without a reference are homed.
    """
    start_deg = rig.pose_after_homing() if here_deg is None else here_deg
    ahead = {}
    for name in _endless(table, rig):
        if name in start_deg and np.ptp(table.angles_deg[name]) > 0:
            turns = math.ceil((start_deg[name] - 1e-3 - float(table.angles_deg[name].min())) / 360.0)
            if turns > 0 and start_deg[name] < UP_TO_DEG:
                ahead[name] = turns
    return add_turns(table, turns_to(table, rig, 0, start_deg, preferred=ahead))


def add_turns(table: StateTable, turns: Mapping[str, int]) -> StateTable:
    """The table with whole turns added to its axes."""
    angles = {name: column + 360.0 * turns.get(name, 0) for name, column in table.angles_deg.items()}
    return replace(table, angles_deg=angles)


def turns_to(
    table: StateTable, rig: Rig, state: int, here_deg: Mapping[str, float], *, preferred: Mapping[str, int]
) -> dict[str, int]:
    """Whole turns to add to the endless axes of a table, so that the way to one of its states is free.

    Parameters
    ----------
    preferred : turns to add where the way with them is free, or no way is.
    """
    names = _endless(table, rig)
    choices = []
    for name in names:
        nearest = round((here_deg.get(name, 0.0) - float(table.angles_deg[name][state])) / 360.0)
        choices.append(list(dict.fromkeys([preferred.get(name, 0), nearest, nearest + 1, nearest - 1, 0])))
    for chosen in product(*choices):
        turns = dict(zip(names, chosen, strict=True))
        by = states_deg(add_turns(table, turns))
        if find_way(rig.config, here_deg, by[state], by, limits=rig.limits) is not None:
            return turns
    return dict(preferred)


def states_deg(table: StateTable) -> list[dict[str, float]]:
    """Angle of each axis in each state."""
    return [{axis: float(column[k]) for axis, column in table.angles_deg.items()} for k in range(len(table))]


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


def _endless(table: StateTable, rig: Rig) -> Sequence[str]:
    free = (
        name for name in rig.config.endless if rig.limits[name].min_deg is None and rig.limits[name].max_deg is None
    )
    return [name for name in free if name in table.angles_deg]
