"""Whether the counts scatter as corrected counts say: light has photon noise, an offset in the counts has none.

An offset and light that leaks through crossed polarizers can be the same in all counts. In their noise they are not.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array, BoolArray
from processing.diagnosis.captures.capture_data import CaptureData, Correct, for_strips
from processing.diagnosis.instrument.photon_noise import exactly_undone, undoing
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.projection import add_response
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.range_of import range_of
from processing.diagnosis.search.rules import NOISE_LEVEL
from processing.diagnosis.search.space import Space

#: Corrections of counts, each undone at its values.
Undone = Mapping[Candidate, Array]


def scatter_prefers(problem: InstrumentProblem, space: Space, values: Array, new: Undone) -> float:
    """Log likelihood of the residual with the noise of the counts that `new` undoes, over that of counts as stored.

    The residual is that of the captures at `values` (K,), the same in both. Of many pixels the noise's own error
    (`NOISE_LEVEL`) is larger than what chance does to their scatter: they say no more than it lets them. Noise that was
    taken from the counts has what an offset lacks or adds in it already, and says nothing.
    """
    problem.relinearize(space, values)
    near, local = problem.near(space, values)
    undone_here = exactly_undone(space, values, pointwise=True)
    gain = pairs = 0.0
    for k, (data, still) in enumerate(zip(near.captures, problem.still, strict=True)):
        if still.noise_estimated or still.told_of_noise:
            continue
        residual, free = _residual(near, k, space, local)
        if undone_here:
            # What is undone stretches the residual with the counts; their noise is that of counts as they were stored.
            _, slope = undoing(still, undone_here)(still.signal.astype(float))
            residual /= np.broadcast_to(slope, still.signal.shape).reshape(residual.shape)
        share, good = free * near.moments[k].shown, data.usable & ~data.clipped
        before, after = (
            _log_scatter(still, residual, share, near.moments[k].counts, good=good, correct=undoing(still, undone))
            for undone in ({}, new)
        )
        gain += 0.5 * (before - after)
        pairs += float(share.sum()) * good.sum() / 2
    return gain / (1 + pairs * NOISE_LEVEL**2 / 2)


def _log_scatter(
    still: CaptureData, r: NDArray[np.float32], share: Array, use: BoolArray, *, good: BoolArray, correct: Correct
) -> float:
    """Minus twice the log likelihood of the scatter of a residual (L, rows, columns), with noise of corrected counts.

    Of the rows to `use` (L,), of which `share` (L,) of the noise is in the residual, and of `good` pixels.
    """
    sums = np.zeros(len(good))

    def strip(rows: slice) -> None:
        part = r[:, rows].astype(float)
        light = still.signal[:, :, rows] - part.reshape(still.signal[:, :, rows].shape)
        variance = still.noise_of(*correct(light)).reshape(part.shape)
        # Of neighbours: what both have in common is no noise, but what the fit does not explain.
        first, second = (slice(k, part.shape[2] // 2 * 2, 2) for k in (0, 1))
        apart = (part[:, :, first] - part[:, :, second])[use]
        pair_noise = (variance[:, :, first] + variance[:, :, second])[use]
        scatter = np.sum(apart**2 / pair_noise, axis=0) + np.tensordot(share[use], np.log(pair_noise), 1)
        sums[rows.start] = scatter[good[rows, first] & good[rows, second]].sum()

    for_strips(len(good), strip)
    return float(sums.sum())


def _residual(problem: InstrumentProblem, k: int, space: Space, values: Array) -> tuple[NDArray[np.float32], Array]:
    """Residual (L, rows, columns) of a capture in counts over full scale, and the share (L,) of noise in it."""
    data, level = problem.captures[k], problem.moments[k].sigma
    changes = problem.changes(k, space, values)
    a = problem.columns(k, changes) * problem.moments[k].counts[:, None]
    counts = data.signal.reshape(data.values_per_pixel, *data.signal.shape[2:])
    y = add_response(counts, problem.coefficients(k, changes), a)
    q = range_of(a)
    outside = (np.eye(len(a)) - q @ q.T) * level[:, None] / level
    residual = outside.astype(np.float32) @ y.reshape(len(a), -1)
    return residual.reshape(y.shape), 1 - np.sum(q * q, axis=1)
