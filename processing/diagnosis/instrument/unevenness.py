"""Whether an effect is as large in every part of the image."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES
from processing.diagnosis.instrument.moments import Tiles
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.projection import Projected
from processing.diagnosis.instrument.slopes import STEP
from processing.diagnosis.instrument.tiles import features_of_tiles
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.space import Space
from processing.instrument.changes import field_terms


class Evenness:
    """The tiles of all images against what a fit left in them."""

    def __init__(self, problem: InstrumentProblem, space: Space, values: Array) -> None:
        """Problem and values (K,) of the space that was fitted."""
        self._fitted, self._space, self._values = problem, space, values
        self._parts: dict[int, Projected] = {}

    @cached_property
    def _near(self) -> tuple[InstrumentProblem, Array]:
        return self._fitted.near(self._space, self._values)

    def varies(self, candidate: Candidate) -> tuple[float, int]:
        """Chi-square by which the size of an effect varies smoothly over the image, beyond noise, and its terms.

        In each tile the effect is scaled, all else held; then second-order surfaces are laid through the tiles. What
        one size for all tiles explains is no variation: values that shrink to their prior leave that over. Both zero
        where the image has no tiles.
        """
        part = self._space.slices[self._space.candidates.index(candidate)]
        problem, local = self._near
        moved = local.copy()
        moved[part] *= 1 + STEP
        out, count = 0.0, 0
        for k, moments in enumerate(problem.moments):
            tiles = moments.tiles
            if tiles is None or not candidate.acts(k, problem.wavelengths_nm[k]):
                continue
            if k not in self._parts:
                self._parts[k] = self._projected(k, tiles)
            slope, power = self._parts[k].of_each((self._rows(k, moved) - self._rows(k, local)) / STEP)
            smooth = np.vstack([np.ones(tiles.x.size), field_terms(tiles.x, tiles.y)])
            pull = smooth @ slope
            out += float(pull @ np.linalg.pinv((smooth * power) @ smooth.T, hermitian=True) @ pull)
            out -= float(pull[0] ** 2 / max(power.sum(), 1e-300))
            count += len(smooth) - 1
        return out - count, count

    def _rows(self, k: int, values: Array) -> Array:
        """(L, K) of the rows that count, in units of their noise."""
        problem, _ = self._near
        rows = problem.columns(k, problem.changes(k, self._space, values))
        return np.asarray(rows[problem.moments[k].counts])

    def _projected(self, k: int, tiles: Tiles) -> Projected:
        """The tiles with the counts corrected: what a shift leaves of an image would seem to vary over it."""
        problem, local = self._near
        moments = problem.moments[k]
        use = np.flatnonzero(moments.counts)
        c = problem.coefficients(k, problem.changes(k, self._space, local))
        asked = np.flatnonzero(np.any(c, axis=1)).tolist()
        known, z, noise = features_of_tiles(problem.captures[k], moments, tiles, asked)
        used = np.array(known)
        rows = self._rows(k, local)
        return Projected(
            z,
            noise,
            np.broadcast_to(rows, (tiles.x.size, *rows.shape)),
            c[None, used][:, :, use],
            around=used >= len(FEATURES) - DERIVATIVES,
        )
