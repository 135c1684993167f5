"""Tiles of the image against a matrix of their own each: what an effect needs that varies over the image."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES
from processing.diagnosis.instrument.moments import Moments, Tiles
from processing.diagnosis.instrument.projection import Projected, add_parts
from processing.diagnosis.instrument.tile_features import features_of_tiles
from processing.diagnosis.instrument.tile_slope_sums import add_slopes
from processing.diagnosis.instrument.tile_slopes import TileSlopes
from processing.diagnosis.search.space import Sums

#: [tiles] That are reckoned with together: what is made of them stays small.
TOGETHER = 32


def add_tiles(
    data: CaptureData,
    moments: Moments,
    tiles: Tiles,
    a: Array,
    c: Array,
    slopes: TileSlopes | None,
    out: Sums,
    apart: int | None = None,
) -> None:
    """Add what tiles say of a (tiles, L, K) and coefficients c (F, L), with their derivatives by each value.

    `apart` : rows of a state, where every state has unknowns of its own; None: all rows have the same unknowns.
    """
    asked = np.any(c, axis=1) if slopes is None else np.any(c, axis=1) | np.any(slopes.dc, axis=(0, 2))
    used, use = np.flatnonzero(asked), np.flatnonzero(moments.counts)
    known, z, noise = features_of_tiles(data, moments, tiles, used.tolist())
    mine = np.searchsorted(known, used)
    around = used >= len(FEATURES) - DERIVATIVES

    def projected(fold: int, kept: slice) -> Iterator[tuple[NDArray[np.int64], Projected]]:
        rows = use[kept]
        scatter = noise[:, kept] if len(known) == used.size else noise[:, kept, mine[:, None], mine]
        here = np.flatnonzero(tiles.fold == fold)
        for some in np.split(here, range(TOGETHER, here.size, TOGETHER)):
            features = z[some[:, None], mine, kept]
            part = Projected(features, scatter[some], a[some][:, rows], c[None, used][:, :, rows], around)
            add_parts(part, moments, rows[None], tiles.pixels[some], fold, out)
            yield some, part

    for kept in _together(use, apart):
        of_rows = None if slopes is None else slopes.of_rows(use[kept], used)
        for fold in range(len(out.excess)):
            if of_rows is None:
                deque(projected(fold, kept), maxlen=0)
            else:
                add_slopes(projected(fold, kept), of_rows, fold, out)


def _together(use: NDArray[np.int64], apart: int | None) -> list[slice]:
    """Which of the rows in use have the same unknowns."""
    bounds = [] if apart is None else (np.flatnonzero(np.diff(use // apart)) + 1).tolist()
    return [slice(i, j) for i, j in pairwise([0, *bounds, use.size])]
