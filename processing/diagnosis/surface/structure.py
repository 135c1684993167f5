"""Is anything but noise left over of an object: tests of the residual."""

from __future__ import annotations

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.range_of import range_of
from processing.diagnosis.search.space import Space
from processing.diagnosis.surface.problem import SurfaceProblem


def structure(problem: SurfaceProblem, k: int, space: Space, values: Array) -> dict[str, float]:
    """Tests of a capture's residual: name to standard deviations from what noise gives.

    Sums over tiles of the object, split into what some Mueller matrix could cause and what none could, which speaks
    against the instrument's model and not against the reflectance.
    """
    here, data = problem.pixels(k, space, values), problem.captures[k]
    r, noise = here.residual, problem.noise[k] * here.free
    out = {"sum of squares": float((np.sum(r**2) - noise.sum()) / np.sqrt(2 * noise.sum()))}
    w = problem.rows(k, problem.changes(k, space, values)[0]) / np.mean(problem.sigma[k], axis=0)[:, None]
    basis = range_of(w)
    rows, rank = basis.shape
    tiles = np.unique(data.tile)
    totals = np.stack([r[data.tile == t].sum(axis=0) for t in tiles])
    level = np.array([noise[data.tile == t].sum() for t in tiles]) / (rows - 2)
    inside = np.sum((totals @ basis) ** 2)
    for name, square, directions in (
        ("smooth over the object", inside, rank - 2),
        ("smooth over the object, of the instrument", np.sum(totals**2) - inside, rows - rank),
    ):
        if directions > 0:
            out[name] = float((square - directions * level.sum()) / np.sqrt(2 * directions * np.sum(level**2)))
    return out
