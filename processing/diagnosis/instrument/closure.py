"""Closure of a polarization camera: I0 + I90 against I45 + I135."""

from __future__ import annotations

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES, features
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.space import Space


def closure(problem: InstrumentProblem, k: int, space: Space, values: Array) -> float | None:
    """Mean of I0 + I90 - I45 - I135 over mean S0, percent, of corrected counts over the gains of their channels."""
    model, data = problem.models[k], problem.captures[k]
    if model.mosaic is None or {c.name for c in model.channels} != {"0", "45", "90", "135"}:
        return None
    changes = problem.changes(k, space, values)
    coefficients = problem.coefficients(k, changes).reshape(len(FEATURES), *data.signal.shape[:2])
    good = data.usable & ~data.clipped
    if not good.any():
        return None
    means = np.zeros(len(model.channels))
    for channel, c in enumerate(model.channels):
        sign = 1.0 if c.name in ("0", "90") else -1.0
        for state in range(data.signal.shape[0]):
            counts = data.signal[state, channel][good].astype(np.float64)
            corrected = np.tensordot(coefficients[:-DERIVATIVES, state, channel], features(counts)[0], axes=1)
            means[channel] += sign * corrected.mean() / changes.gain[state, channel]
    return float(100 * means.sum() / (np.abs(means).sum() / 2))
