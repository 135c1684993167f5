"""Whether the counts scatter as corrected counts say: light has photon noise, an offset in the counts has none.

An offset and light that leaks through crossed polarizers can be the same in all counts. In their noise they are not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.projection import RANK, add_response
from processing.diagnosis.instrument.undone import undone_signal
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.space import Space

#: Corrections of counts, each undone at its values.
Undone = Mapping[Candidate, Array]


def scatter_prefers(problem: InstrumentProblem, space: Space, values: Array, new: Undone, old: Undone) -> float:
    """Log likelihood of the residual with the noise of the counts that `new` undoes, over that with `old`.

    The residual is that of the captures at `values` (K,), the same in both.
    """
    problem.relinearize(space, values)
    near, local = problem.near(space, values)
    gain = 0.0
    for k, (data, still) in enumerate(zip(near.captures, problem.still, strict=True)):
        rest, free = _rest(near, k, space, local)
        light = (still.signal.reshape(rest.shape) - rest).reshape(still.signal.shape)
        mean = replace(still, signal=light.astype(np.float32))
        good = data.usable & ~data.clipped
        use = near.moments[k].counts
        share = (free * near.moments[k].left)[use, None]
        of = []
        for undone in (new, old):
            variance = mean.with_noise_of(*undone_signal(mean, undone)).variance().reshape(rest.shape)[use][:, good]
            of.append(float(np.sum(rest[use][:, good] ** 2 / variance + share * np.log(variance))))
        gain += 0.5 * (of[1] - of[0])
    return gain


def _rest(problem: InstrumentProblem, k: int, space: Space, values: Array) -> tuple[Array, Array]:
    """Residual (L, rows, columns) of a capture in counts over full scale, and the share (L,) of noise in it."""
    data, level = problem.captures[k], problem.moments[k].sigma
    changes = problem.changes(k, space, values)
    a = problem.columns(k, changes) * problem.moments[k].counts[:, None]
    counts = data.signal.reshape(data.values_per_pixel, *data.signal.shape[2:]).astype(np.float64)
    y = add_response(counts, problem.coefficients(k, changes), a)
    u, size, _ = np.linalg.svd(a, full_matrices=False)
    q = u[:, size > RANK * size[0]]
    flat = y.reshape(y.shape[0], -1) / level[:, None]
    rest = (flat - q @ (q.T @ flat)) * level[:, None]
    return rest.reshape(y.shape), 1 - np.sum(q * q, axis=1)
