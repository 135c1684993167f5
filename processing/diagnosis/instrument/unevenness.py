"""Whether an effect is as large in every part of the image."""

from __future__ import annotations

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.projection import RANK
from processing.diagnosis.instrument.slopes import STEP
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.space import Space
from processing.instrument.changes import field_terms


def unevenness(problem: InstrumentProblem, candidate: Candidate, space: Space, values: Array) -> tuple[float, int]:
    """Chi-square by which the size of an effect varies smoothly over the image, beyond noise, and its terms.

    In each tile the effect is scaled, all else held; then second-order surfaces are laid through the tiles. What one
    size for all tiles explains is no variation: values that shrink to their prior leave that over. Both zero where the
    image has no tiles.
    """
    problem, local = problem.near(space, values)
    part = space.slices[space.candidates.index(candidate)]
    out, count = 0.0, 0
    for k, moments in enumerate(problem.moments):
        tiles = moments.tiles
        if tiles is None or not candidate.acts(k, problem.wavelengths_nm[k]):
            continue
        a = problem.columns(k, problem.changes(k, space, local))
        moved = local.copy()
        moved[part] *= 1 + STEP
        da = (problem.columns(k, problem.changes(k, space, moved)) - a) / STEP
        use = moments.counts
        a, da, sigma = a[use], da[use], moments.sigma[use]
        u, size, vt = np.linalg.svd(a, full_matrices=False)
        keep = size > RANK * size[0]
        q = u[:, keep]
        b = (da - q @ (q.T @ da)) @ (vt[keep].T / size[keep]) @ q.T
        s = tiles.s[:, use][:, :, use] / sigma[:, None] / sigma
        ps = s - q @ (q.T @ s)
        # As in `add_tiles`: the slope of the excess of each tile by the size of the effect there, and its noise.
        slope = -np.sum(ps * b, axis=(1, 2)) + (tiles.noise[:, use] / sigma**2) @ np.diag(b)
        power = np.sum((b @ s) * b, axis=(1, 2))
        smooth = np.vstack([np.ones(tiles.x.size), field_terms(tiles.x, tiles.y)])
        pull = smooth @ slope
        out += float(pull @ np.linalg.pinv((smooth * power) @ smooth.T, hermitian=True) @ pull)
        out -= float(pull[0] ** 2 / max(power.sum(), 1e-300))
        count += len(smooth) - 1
    return out - count, count
