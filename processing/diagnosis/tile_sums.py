"""Tiles of the image against a matrix of their own each: what an effect needs that varies over the image."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from processing.applied_effects import extra_retardance, with_extra
from processing.changes import Changes
from processing.diagnosis.capture_data import CaptureData
from processing.diagnosis.moments import DERIVATIVES, FEATURES, Moments, Tiles, tile_products
from processing.diagnosis.projection import RANK
from processing.diagnosis.space import Sums
from processing.instrument import InstrumentModel

Array = NDArray[np.float64]
#: A retarder's Mueller matrix is linear in 1, cosine and sine of its retardance: three values tell all.
THIRDS = (0.0, 2 * np.pi / 3, 4 * np.pi / 3)


def tile_columns(model: InstrumentModel, data: CaptureData, moments: Moments, changes: Changes) -> Array:
    """A (tiles, L, K) where a retardance varies over the image, rows in units of their noise."""
    tiles = moments.tiles
    if tiles is None:
        raise ValueError("a capture that holds out states has no tiles")
    extra = extra_retardance(changes, tiles.x, tiles.y)
    rows = data.values_per_pixel
    out = np.zeros((tiles.x.size, rows, 16))
    for nodes in product(THIRDS, repeat=len(extra)):
        weight = np.prod((1 + 2 * np.cos(extra - np.array(nodes)[:, None])) / 3, axis=0)
        w = model.rows(data.conditions.angles_deg, with_extra(changes, np.array(nodes))).reshape(rows, 16)
        out += weight[:, None, None] * w
    a = out if data.sample is None else (out @ data.sample)[..., None]
    return np.asarray(a * (data.row_exposure / moments.sigma)[:, None])


def add_tiles(
    data: CaptureData, moments: Moments, tiles: Tiles, a: Array, c: Array, da: Array, dc: Array, out: Sums
) -> None:
    """Add what tiles say of a (tiles, L, K) and coefficients c (F, L), with their derivatives by each value.

    As `add_block`, from the second moments: y = B z with z the features of the counts, one below the other.
    """
    used = np.flatnonzero(np.any(c, axis=1) | np.any(dc, axis=(0, 2)))
    s, noise = tile_products(data, tiles, used.tolist())
    sigma, rows = moments.sigma, a.shape[1]
    scale = np.tile(1 / sigma, used.size)
    s, noise = s * scale[:, None] * scale, noise / (sigma**2)[:, None, None]
    u, size, vt = np.linalg.svd(a, full_matrices=False)
    keep = size > RANK * size[:, :1]
    q = u * keep[:, None, :]
    pinv = np.einsum("tri,tr,tlr->til", vt, np.where(keep, 1 / np.maximum(size, 1e-300), 0.0), u)
    back = pinv.transpose(0, 2, 1)
    hat = q @ q.transpose(0, 2, 1)
    outside = np.eye(rows) - hat
    # What takes each feature to the rows: derivatives are those of the fitted image.
    takes = np.where((used < len(FEATURES) - DERIVATIVES)[:, None], np.eye(rows)[:, None], hat[:, :, None])
    b = c[used].T[:, :, None] * takes
    residual = (outside @ b.reshape(*hat.shape[:2], -1)).reshape(b.shape)
    mean = np.einsum("tlfk,tkfh->tlhk", residual, noise)
    expected = np.sum(mean * residual, axis=(1, 2, 3))
    zy = s @ b.reshape(*hat.shape[:2], -1).transpose(0, 2, 1)
    yy = b.reshape(*hat.shape[:2], -1) @ zy
    ry = outside @ yy
    np.add.at(out.excess, tiles.fold, np.trace(ry, axis1=1, axis2=2) - expected)
    np.add.at(out.freedom, tiles.fold, expected)
    left = np.diagonal(ry @ outside, axis1=1, axis2=2) @ sigma**2
    np.add.at(out.square, tiles.fold, left * moments.relative)
    np.add.at(out.count, tiles.fold, np.diagonal(outside, axis1=1, axis2=2) @ moments.left * tiles.pixels)
    if not len(da):
        return
    # dr = -P dA A+ y + P dB z.
    da = outside @ da
    carried = np.einsum("tlfk,tmfk->tml", b, mean)
    gradient = np.einsum("ktli,tli->kt", da, (carried - ry) @ back)
    ds = da @ (pinv @ yy @ back)
    curvature = np.zeros((len(out.excess), len(da), len(da)))
    folds = [tiles.fold == f for f in range(len(out.excess))]
    for f, mine in enumerate(folds):
        curvature[f] = _flat(ds[:, mine]) @ _flat(da[:, mine]).T
    counted = np.flatnonzero(np.any(dc, axis=(1, 2)))
    rz = outside @ zy.transpose(0, 2, 1)
    moved = {}
    for j in counted:
        db = dc[j, used].T[:, :, None] * takes
        gradient[j] += np.sum(db * (rz.reshape(db.shape) - mean), axis=(1, 2, 3))
        moved[j] = outside @ db.reshape(rz.shape)
    for j in counted:
        es = moved[j] @ s
        across = np.einsum("ktli,tli->kt", da, es @ b.reshape(rz.shape).transpose(0, 2, 1) @ back)
        for f, mine in enumerate(folds):
            curvature[f, j] -= across[:, mine].sum(axis=1)
            curvature[f, :, j] -= across[:, mine].sum(axis=1)
            for i in counted:
                curvature[f, i, j] += np.sum(es[mine] * moved[i][mine])
    for f, mine in enumerate(folds):
        out.gradient[f] += gradient[:, mine].sum(axis=1)
    out.curvature += curvature


def _flat(x: Array) -> Array:
    return x.reshape(len(x), -1)
