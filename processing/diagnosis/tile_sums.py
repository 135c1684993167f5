"""Tiles of the image against a matrix of their own each: what an effect needs that varies over the image."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from processing.applied_effects import extra_retardance, with_extra
from processing.changes import Changes
from processing.diagnosis.capture_data import CaptureData
from processing.diagnosis.moments import Moments, Tiles
from processing.diagnosis.projection import RANK
from processing.diagnosis.space import Sums
from processing.instrument import InstrumentModel

Array = NDArray[np.float64]
#: A retarder's Mueller matrix is linear in 1, cosine and sine of its retardance: three values tell all.
THIRDS = (0.0, 2 * np.pi / 3, 4 * np.pi / 3)


def tile_columns(model: InstrumentModel, data: CaptureData, moments: Moments, changes: Changes) -> Array:
    """A (tiles, L, K) where a retardance varies over the image, rows in units of their noise."""
    tiles = _of(moments)
    extra = extra_retardance(changes, tiles.x, tiles.y)
    rows = data.values_per_pixel
    out = np.zeros((tiles.x.size, rows, 16))
    for nodes in product(THIRDS, repeat=len(extra)):
        weight = np.prod((1 + 2 * np.cos(extra - np.array(nodes)[:, None])) / 3, axis=0)
        w = model.rows(data.conditions.angles_deg, with_extra(changes, np.array(nodes))).reshape(rows, 16)
        out += weight[:, None, None] * w
    a = out if data.sample is None else (out @ data.sample)[..., None]
    return np.asarray(a * (data.row_exposure / moments.sigma)[:, None])


def add_tiles(moments: Moments, a: Array, da: Array, out: Sums) -> None:
    """Add what the tiles say of a (tiles, L, K) and its derivatives (values, tiles, L, K).

    The counts are taken as they are.
    """
    tiles, sigma = _of(moments), moments.sigma
    s = tiles.s / sigma[:, None] / sigma
    noise = tiles.noise / sigma**2
    u, size, vt = np.linalg.svd(a, full_matrices=False)
    keep = size > RANK * size[:, :1]
    q = u * keep[:, None, :]
    pinv = np.einsum("tri,tr,tlr->til", vt, np.where(keep, 1 / np.maximum(size, 1e-300), 0.0), u)
    ps = s - q @ (q.transpose(0, 2, 1) @ s)
    free = 1 - np.einsum("tlr,tlr->tl", q, q)
    excess = np.einsum("tll->t", ps - (ps @ q) @ q.transpose(0, 2, 1)) - np.sum(free * noise, axis=1)
    np.add.at(out.excess, tiles.fold, excess)
    np.add.at(out.freedom, tiles.fold, np.sum(free * noise, axis=1))
    left = np.einsum("tll->tl", ps - (ps @ q) @ q.transpose(0, 2, 1)) @ sigma**2
    np.add.at(out.square, tiles.fold, left * moments.relative)
    np.add.at(out.count, tiles.fold, free @ moments.left * tiles.pixels)
    if not len(da):
        return
    # dr_k = -P dA_k A+ y = -B_k y: <r, dr_k> = -tr(P S B_k^T), <dr_k, dr_l> = tr(B_k S B_l^T).
    da = da - q @ (q.transpose(0, 2, 1) @ da)
    back = pinv.transpose(0, 2, 1)
    gradient = np.einsum("ktli,tli->kt", da, noise[:, :, None] * back - ps @ back)
    ds = da @ (pinv @ s @ back)
    for fold in range(len(out.excess)):
        mine = tiles.fold == fold
        out.gradient[fold] += gradient[:, mine].sum(axis=1)
        out.curvature[fold] += ds[:, mine].reshape(len(da), -1) @ da[:, mine].reshape(len(da), -1).T


def _of(moments: Moments) -> Tiles:
    if moments.tiles is None:
        raise ValueError("a capture that holds out states has no tiles")
    return moments.tiles
