"""Tiles of the image against a matrix of their own each: what an effect needs that varies over the image."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

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

#: Tiles that are reckoned with together: what is made of them stays small.
TOGETHER = 32


def add_tiles(
    data: CaptureData, moments: Moments, tiles: Tiles, a: Array, c: Array, slopes: TileSlopes | None, out: Sums
) -> None:
    """Add what tiles say of a (tiles, L, K) and coefficients c (F, L), with their derivatives by each value."""
    asked = np.any(c, axis=1) if slopes is None else np.any(c, axis=1) | np.any(slopes.dc, axis=(0, 2))
    used, use = np.flatnonzero(asked), np.flatnonzero(moments.counts)
    known, z, noise = features_of_tiles(data, moments, tiles, used.tolist())
    mine = np.searchsorted(known, used)
    noise = noise if len(known) == used.size else noise[:, :, mine[:, None], mine]
    around = used >= len(FEATURES) - DERIVATIVES
    c, a = c[None, used][:, :, use], a[:, use]
    slopes = None if slopes is None else slopes.of_rows(use, used)

    def projected(fold: int) -> Iterator[tuple[NDArray[np.int64], Projected]]:
        here = np.flatnonzero(tiles.fold == fold)
        for some in np.split(here, range(TOGETHER, here.size, TOGETHER)):
            part = Projected(z[some[:, None], mine], noise[some], a[some], c, around)
            add_parts(part, moments, use[None], tiles.pixels[some], fold, out)
            yield some, part

    for fold in range(len(out.excess)):
        if slopes is None:
            deque(projected(fold), maxlen=0)
        else:
            add_slopes(projected(fold), slopes, fold, out)
