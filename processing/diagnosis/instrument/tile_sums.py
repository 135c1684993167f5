"""Tiles of the image against a matrix of their own each: what an effect needs that varies over the image."""

from __future__ import annotations

from itertools import product

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES
from processing.diagnosis.instrument.moments import Moments, Tiles, features_of_tiles
from processing.diagnosis.instrument.projection import Projected, add_parts
from processing.diagnosis.search.space import Sums
from processing.instrument.changes import Changes
from processing.instrument.model import InstrumentModel
from processing.reduction.effects_of_capture import extra_retardance, with_extra

#: Tiles that are reckoned with together: what is made of them stays small.
TOGETHER = 32
#: A retarder's Mueller matrix is linear in 1, cosine and sine of its retardance: three values tell all.
THIRDS = (0.0, 2 * np.pi / 3, 4 * np.pi / 3)


def tile_columns(model: InstrumentModel, data: CaptureData, moments: Moments, changes: Changes) -> Array:
    """A (tiles, L, K) where a retardance varies over the image, rows in units of their noise."""
    tiles = moments.tiles
    if tiles is None:
        raise ValueError("a capture that holds out states has no tiles")
    extra = extra_retardance(changes, tiles.x, tiles.y)
    nodes = np.array(list(product(THIRDS, repeat=len(extra)))).reshape(len(THIRDS) ** len(extra), len(extra))
    weights = np.prod((1 + 2 * np.cos(extra - nodes[:, :, None])) / 3, axis=1)
    angles = data.conditions.angles_deg
    at_nodes = np.stack([model.rows(angles, with_extra(changes, node)).reshape(-1, 16) for node in nodes])
    w = np.tensordot(weights, at_nodes, axes=(0, 0))
    a = w if data.sample is None else (w @ data.sample)[..., None]
    return np.asarray(a * (data.row_exposure / moments.sigma)[:, None])


def add_tiles(
    data: CaptureData, moments: Moments, tiles: Tiles, a: Array, c: Array, da: Array, dc: Array, out: Sums
) -> None:
    """Add what tiles say of a (tiles, L, K) and coefficients c (F, L), with their derivatives by each value."""
    asked = np.flatnonzero(np.any(c, axis=1) | np.any(dc, axis=(0, 2)))
    known, z, noise = features_of_tiles(data, tiles, asked.tolist())
    used, use = np.array(known), np.flatnonzero(moments.counts)
    sigma, around = moments.sigma[use], used >= len(FEATURES) - DERIVATIVES
    c, dc = c[None, used][:, :, use], dc[:, None, used][..., use]
    for fold in range(len(out.excess)):
        mine = np.flatnonzero(tiles.fold == fold)
        for some in np.split(mine, range(TOGETHER, mine.size, TOGETHER)):
            of_noise = noise[some][:, use] / (sigma**2)[:, None, None]
            part = Projected(z[some][:, :, use] / sigma[:, None], of_noise, a[some][:, use], c, around)
            slopes = da.take(some, axis=1).take(use, axis=2)
            add_parts(part, slopes, dc, moments, use[None], tiles.pixels[some], fold, out)
