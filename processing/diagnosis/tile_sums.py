"""Tiles of the image against a matrix of their own each: what an effect needs that varies over the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from processing.changes import Changes
from processing.diagnosis.capture_data import CaptureData
from processing.diagnosis.moments import Moments, Tiles
from processing.diagnosis.projection import RANK
from processing.diagnosis.space import Sums
from processing.effects.field_retardance import terms
from processing.instrument import InstrumentModel

Array = NDArray[np.float64]


def tile_columns(model: InstrumentModel, data: CaptureData, moments: Moments, changes: Changes) -> Array:
    """A (tiles, L, K) where a retardance varies over the image, rows in units of their noise."""
    tiles = _of(moments)
    smooth = terms(tiles.x, tiles.y)
    count = tiles.x.size
    # All tiles at once: the states are repeated tile by tile, each with its own retardance.
    n = data.conditions.states
    tiled = _tiled(changes, count, n)
    for element, coefficients in changes.field_retardance_rad.items():
        extra = np.repeat(coefficients @ smooth, n)
        tiled.retardance_rad[element] = tiled.retardance_rad[element] + extra
    angles = {axis: np.tile(v, count) for axis, v in data.conditions.angles_deg.items()}
    w = model.rows(angles, tiled).reshape(count, -1, 16) * data.row_exposure[:, None]
    a = w if data.sample is None else (w @ data.sample)[..., None]
    return np.asarray(a / moments.sigma[:, None])


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
    b = da @ pinv
    bs = b @ s
    gradient = -np.sum(ps * b, axis=(2, 3)) + np.sum(np.diagonal(b, axis1=2, axis2=3) * noise, axis=2)
    for fold in range(len(out.excess)):
        mine = tiles.fold == fold
        out.gradient[fold] += gradient[:, mine].sum(axis=1)
        flat = bs[:, mine].reshape(len(da), -1)
        out.curvature[fold] += flat @ b[:, mine].reshape(len(da), -1).T


def _of(moments: Moments) -> Tiles:
    if moments.tiles is None:
        raise ValueError("a capture that holds out states has no tiles")
    return moments.tiles


def _tiled(changes: Changes, count: int, states: int) -> Changes:
    conditions = replace(changes.conditions, states=states * count)
    out = Changes(conditions)
    for name in ("azimuth_rad", "retardance_rad", "extinction", "diattenuation"):
        for element, value in getattr(changes, name).items():
            getattr(out, name)[element] = np.tile(value, count) if np.ndim(value) else value
    out.after, out.stray, out.mixing = dict(changes.after), changes.stray, changes.mixing
    out.gain = np.tile(changes.gain, (count, 1))
    return out
