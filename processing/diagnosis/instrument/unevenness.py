"""Whether an effect is as large in every part of the image."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES
from processing.diagnosis.instrument.moments import Tiles
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.projection import Projected
from processing.diagnosis.instrument.tiles import features_of_tiles
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.rules import STEP
from processing.diagnosis.search.space import Space
from processing.instrument.changes import field_terms


class Evenness:
    """The tiles of all images against what a fit left in them."""

    def __init__(self, problem: InstrumentProblem, space: Space, values: Array) -> None:
        """Problem and values (K,) of the space that was fitted."""
        self._fitted, self._space, self._values = problem, space, values
        self._parts: dict[tuple[int, tuple[int, ...]], tuple[Projected, NDArray[np.int64]]] = {}

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
        # What was undone in the counts has no value left there.
        moved = local.copy()
        moved[part] += STEP * self._values[part]
        chi2, count = 0.0, 0
        for k, moments in enumerate(problem.moments):
            tiles = moments.tiles
            if tiles is None or not candidate.acts(k, problem.wavelengths_nm[k]):
                continue
            rows, c = self._at(k, local)
            moved_rows, more = self._at(k, moved)
            dc = (more - c) / STEP
            projected, used = self._projected(k, tiles, rows, c, dc=dc)
            slope, power = projected.of_each((moved_rows - rows) / STEP, dc[used])
            smooth = np.vstack([np.ones(tiles.x.size), field_terms(tiles.x, tiles.y)])
            pull = smooth @ slope
            chi2 += float(pull @ np.linalg.pinv((smooth * power) @ smooth.T, hermitian=True) @ pull)
            chi2 -= float(pull[0] ** 2 / max(power.sum(), 1e-300))
            count += len(smooth) - 1
        return chi2 - count, count

    def _at(self, k: int, values: Array) -> tuple[Array, Array]:
        """Rows (L, K) that count, in units of their noise, and coefficients (F, L) of their counts."""
        problem, _ = self._near
        changes, use = problem.changes(k, self._space, values), problem.moments[k].counts
        return np.asarray(problem.columns(k, changes)[use]), problem.coefficients(k, changes)[:, use]

    def _projected(
        self, k: int, tiles: Tiles, rows: Array, c: Array, *, dc: Array
    ) -> tuple[Projected, NDArray[np.int64]]:
        """The tiles with the counts corrected, and the features they have: what a shift leaves seems to vary."""
        problem, _ = self._near
        numbers = tuple(np.flatnonzero(np.any(c, axis=1) | np.any(dc, axis=1)).tolist())
        if (k, numbers) not in self._parts:
            columns, z, noise = features_of_tiles(problem.captures[k], problem.moments[k], tiles, numbers)
            used = np.array(columns)
            around = used >= len(FEATURES) - DERIVATIVES
            wide = np.broadcast_to(rows, (tiles.x.size, *rows.shape))
            self._parts[k, numbers] = Projected(z, noise, wide, c[None, used], around=around), used
        return self._parts[k, numbers]
