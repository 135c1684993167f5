"""The step to the minimum of a quadratic form between bounds."""

from __future__ import annotations

import numpy as np

from processing.arrays import Array, BoolArray
from processing.diagnosis.search.range_of import RANK


def bounded_step(g: Array, h: Array, lowest: Array, highest: Array, *, free: BoolArray) -> Array:
    """Step (K,) to the minimum of 2 g . s + s . h . s between two bounds (K,); all but the `free` values (K,) stay.

    If a value were only cut back at its bound, the others would still compensate for the part that was cut off. So
    values that reach a bound are held there, and one that gains is released, until none does. The sum falls with every
    step, so it ends (an active-set method; Nocedal and Wright, Numerical Optimization, 2006, section 16.5).
    """
    step, free, unit = np.zeros_like(g), free & (lowest < highest), np.sqrt(np.maximum(np.diag(h), 1e-300))
    held = ~free | ((lowest >= 0) & (g > 0)) | ((highest <= 0) & (g < 0))
    # Rounding could release and hold the same value for ever.
    for _ in range(10 * g.size):
        slope, moves = g + h @ step, np.flatnonzero(~held)
        toward = np.zeros_like(g)
        toward[moves] = -np.linalg.solve(h.take(moves, 0).take(moves, 1), slope[moves])
        target = step + toward
        beyond = ~held & ((target < lowest) | (target > highest))
        if beyond.any():
            cut = np.clip(target, lowest, highest)
            if not (cut - step) @ (2 * slope + h @ (cut - step)) < 0:
                # All of them at once would lose: as far as the first bound.
                room = np.full_like(g, np.inf)
                room[beyond] = (cut - step)[beyond] / toward[beyond]
                beyond = np.arange(g.size) == np.argmin(room)
                cut = np.where(beyond, cut, step + room.min() * toward)
            step, held = cut, held | beyond
            continue
        step, slope = target, g + h @ target
        # A value at its lower bound gains by a release if the sum falls upwards.
        pull = np.where(held & free, np.where(step <= lowest, -slope, slope), 0.0) / unit
        k = int(np.argmax(pull))
        if not pull[k] > RANK * np.sqrt(abs(g @ step)):
            break
        held[k] = False
    return step
