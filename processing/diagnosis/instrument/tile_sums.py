"""Tiles of the image against a matrix of their own each: what an effect needs that varies over the image."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES
from processing.diagnosis.instrument.moments import Moments, Tiles, features_of_tiles
from processing.diagnosis.instrument.projection import RANK
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
    c, dc = c[used][:, use], dc[:, used][:, :, use]
    for fold in range(len(out.excess)):
        mine = np.flatnonzero(tiles.fold == fold)
        for some in np.split(mine, range(TOGETHER, mine.size, TOGETHER)):
            of_noise = noise[some][:, use] / (sigma**2)[:, None, None]
            part = _Tiled(z[some][:, :, use] / sigma[:, None], of_noise, a[some][:, use], c, around)
            squares, left = np.sum(part.residual**2, axis=(0, 2)), float(part.expected.sum())
            out.excess[fold] += squares.sum() - left
            out.freedom[fold] += left
            out.square[fold] += squares @ sigma**2 * moments.relative
            free = np.diagonal(part.outside, axis1=1, axis2=2)
            out.count[fold] += tiles.pixels[some] @ free @ moments.left[use]
            if len(da):
                gradient, stretch, curvature = part.slopes(da.take(some, axis=1).take(use, axis=2), dc)
                out.gradient[fold] += gradient
                out.stretch[fold] += stretch
                out.curvature[fold] += curvature


class _Tiled:
    """As `add_block` with several tiles at once, each against a matrix of its own.

    Attributes
    ----------
    outside : (T, L, L) projection P; residual : (T, L, R) P y; expected : (T,) squares of noise alone.
    """

    def __init__(self, z: Array, noise: Array, a: Array, c: Array, around: NDArray[np.bool_]) -> None:
        """z (T, F, L, R), noise (T, L, F, F), a (T, L, K), c (F, L); `around` (F,) features that are derivatives."""
        rows = a.shape[1]
        u, size, vt = np.linalg.svd(a, full_matrices=False)
        keep = size > RANK * size[:, :1]
        q = u * keep[:, None, :]
        # A+, turned over.
        self._back = q * np.where(keep, 1 / np.maximum(size, 1e-300), 0.0)[:, None, :] @ vt
        hat = q @ q.transpose(0, 2, 1)
        self.outside = np.eye(rows) - hat
        # Derivatives are those of the fitted image.
        self._z = z
        self._z[:, around] = hat[:, None] @ z[:, around]
        self._y = np.einsum("fl,tflr->tlr", c, self._z)
        self.residual = self.outside @ self._y
        # What takes the noise of each feature to the rows, and the mean product of the residual's noise with it.
        takes = np.where(around[:, None], hat[:, :, None], np.eye(rows)[:, None])
        onto = c.T[:, :, None] * takes
        left = (self.outside @ onto.reshape(*hat.shape[:2], -1)).reshape(onto.shape)
        mean = (left.transpose(0, 3, 1, 2) @ noise).transpose(0, 2, 3, 1)
        self.expected = np.sum(mean * left, axis=(1, 2, 3))
        self._carried = mean.reshape(*hat.shape[:2], -1) @ onto.reshape(*hat.shape[:2], -1).transpose(0, 2, 1)
        self._of_features = np.sum(takes * mean, axis=3)

    def slopes(self, da: Array, dc: Array) -> tuple[Array, Array, Array]:
        """Half gradient (K,) of the excess and of its noise, and curvature (K, K) of the excess, summed over the tiles.

        From dr = -P dA A+ y + P dB z.
        """
        da = self.outside @ da
        yy = self._y @ self._y.transpose(0, 2, 1)
        pull = _flat(dc) @ self._of_features.sum(axis=0).T.reshape(-1)
        pull -= _flat(da) @ (self._carried @ self._back).reshape(-1)
        gradient = -pull - _flat(da) @ (self.outside @ yy @ self._back).reshape(-1)
        # A+ y as few pseudo-pixels.
        value, vector = np.linalg.eigh(self._back.transpose(0, 2, 1) @ yy @ self._back)
        along = _flat(da @ (vector * np.sqrt(np.maximum(value, 0.0))[:, None]))
        curvature = along @ along.T
        counted = np.flatnonzero(np.any(dc, axis=(1, 2)))
        if counted.size:
            of_counts = np.stack([self.outside @ self._weighted(dc[j]) for j in counted])
            gradient[counted] += _flat(of_counts) @ self.residual.reshape(-1)
            across = _flat(of_counts @ (self._y.transpose(0, 2, 1) @ self._back)) @ _flat(da).T
            curvature[counted] -= across
            curvature[:, counted] -= across.T
            curvature[np.ix_(counted, counted)] += _flat(of_counts) @ _flat(of_counts).T
        return gradient, pull, curvature

    def _weighted(self, c: Array) -> Array:
        """Sum (T, L, R) of the features, each times its coefficient (F, L)."""
        used = np.flatnonzero(np.any(c, axis=1))
        return np.asarray(np.einsum("fl,tflr->tlr", c[used], self._z[:, used]))


def _flat(x: Array) -> Array:
    return x.reshape(len(x), -1)
