"""Tiles of the image against a matrix of their own each: what an effect needs that varies over the image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES
from processing.diagnosis.instrument.moments import Moments, Tiles, tile_products
from processing.diagnosis.instrument.projection import RANK
from processing.diagnosis.search.space import Sums
from processing.instrument.changes import Changes
from processing.instrument.model import InstrumentModel
from processing.reduction.effects_of_capture import extra_retardance, with_extra

#: Tiles that are reckoned with together: their products are copied for it.
TOGETHER = 32
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
    """Add what tiles say of a (tiles, L, K) and coefficients c (F, L), with their derivatives by each value."""
    asked = np.flatnonzero(np.any(c, axis=1) | np.any(dc, axis=(0, 2)))
    known, *products = tile_products(data, tiles, asked.tolist())
    used = np.array(known)
    use = np.flatnonzero(moments.counts)
    of_features = c[used][:, use], dc[:, used][:, :, use]
    for first in range(0, tiles.x.size, TOGETHER):
        some = slice(first, first + TOGETHER)
        _add_some(moments, tiles, some, products, used, (a[some][:, use], da[:, some][:, :, use]), of_features, out)


def _add_some(
    moments: Moments,
    tiles: Tiles,
    some: slice,
    products: Sequence[Array],
    used: NDArray[np.int64],
    of_rows: tuple[Array, Array],
    of_features: tuple[Array, Array],
    out: Sums,
) -> None:
    """Add `some` of the tiles: rows and coefficients of the features that are `used`, each with its derivatives."""
    (a, da), (c, dc), (s, noise) = of_rows, of_features, (each[some] for each in products)
    use, fold = moments.counts, tiles.fold[some]
    if not use.all():
        every = np.flatnonzero(np.tile(use, used.size))
        s, noise = s[:, every][:, :, every], noise[:, use]
    sigma = moments.sigma[use]
    scale = np.tile(1 / sigma, used.size)
    around = used >= len(FEATURES) - DERIVATIVES
    all_tiles = _Tiled(s * scale[:, None] * scale, noise / (sigma**2)[:, None, None], a, c, around)
    squares = np.diagonal(all_tiles.ry @ all_tiles.outside, axis1=1, axis2=2)
    free = np.diagonal(all_tiles.outside, axis1=1, axis2=2)
    np.add.at(out.excess, fold, squares.sum(axis=1) - all_tiles.expected)
    np.add.at(out.freedom, fold, all_tiles.expected)
    np.add.at(out.square, fold, squares @ sigma**2 * moments.relative)
    np.add.at(out.count, fold, free @ moments.left[use] * tiles.pixels[some])
    if len(da):
        folds = [fold == f for f in range(len(out.excess))]
        gradient, stretch, curvature = all_tiles.slopes(da, dc, folds)
        out.gradient += gradient
        out.stretch += stretch
        out.curvature += curvature


class _Tiled:
    """As `add_block` with all tiles at once, from the second moments of the features z of the counts: y = B z.

    Attributes
    ----------
    outside : (T, L, L) projection P; ry : (T, L, L) products of residual and y; expected : (T,) squares of noise alone.
    """

    def __init__(self, s: Array, noise: Array, a: Array, c: Array, around: NDArray[np.bool_]) -> None:
        """s (T, F L, F L), noise (T, L, F, F), a (T, L, K), c (F, L); `around` (F,) features that are derivatives."""
        self._s = s
        count, rows = a.shape[:2]
        u, size, vt = np.linalg.svd(a, full_matrices=False)
        keep = size > RANK * size[:, :1]
        q = u * keep[:, None, :]
        # A+, turned over.
        self._back = q * np.where(keep, 1 / np.maximum(size, 1e-300), 0.0)[:, None, :] @ vt
        hat = q @ q.transpose(0, 2, 1)
        self.outside = np.eye(rows) - hat
        # What takes each feature to the rows: derivatives are those of the fitted image.
        self._takes = np.where(around[:, None], hat[:, :, None], np.eye(rows)[:, None])
        self._b = self._onto(c)
        zy = s @ self._b.transpose(0, 2, 1)
        self._rz = self.outside @ zy.transpose(0, 2, 1)
        self._yy = self._b @ zy
        self.ry = self.outside @ self._yy
        residual = (self.outside @ self._b).reshape(self._takes.shape)
        # Mean product of the residual's noise with that of each feature.
        self._mean = np.einsum("tlfk,tkfh->tlhk", residual, noise)
        self.expected = np.sum(self._mean * residual, axis=(1, 2, 3))
        self._mean = self._mean.reshape(count, rows, -1)

    def _onto(self, c: Array) -> Array:
        """B (T, L, F L) of coefficients c (F, L)."""
        return np.asarray((c.T[:, :, None] * self._takes).reshape(*self.outside.shape[:2], -1))

    def slopes(self, da: Array, dc: Array, folds: Sequence[NDArray[np.bool_]]) -> tuple[Array, Array, Array]:
        """Half gradient (folds, K) of the excess and of its noise, and curvature (folds, K, K) of the excess.

        From dr = -P dA A+ y + P dB z.
        """
        da = self.outside @ da
        noise = self._mean @ self._b.transpose(0, 2, 1)
        slope = np.einsum("ktli,tli->kt", da, (noise - self.ry) @ self._back)
        pull = -np.einsum("ktli,tli->kt", da, noise @ self._back)
        counted = {int(j): self._parts(dc[j]) for j in np.flatnonzero(np.any(dc, axis=(1, 2)))}
        for j, parts in counted.items():
            for f, db in parts.items():
                here = self._rows_of(f)
                slope[j] += np.sum(db * (self._rz - self._mean)[:, :, here], axis=(1, 2))
                pull[j] += np.sum(db * self._mean[:, :, here], axis=(1, 2))
        gradient = np.stack([slope[:, mine].sum(axis=1) for mine in folds])
        stretch = np.stack([pull[:, mine].sum(axis=1) for mine in folds])
        ds = da @ (self._back.transpose(0, 2, 1) @ self._yy @ self._back)
        curvature = np.stack([_flat(ds[:, mine]) @ _flat(da[:, mine]).T for mine in folds])
        onto_unknowns = self._b.transpose(0, 2, 1) @ self._back
        for j, parts in counted.items():
            es = np.sum([(self.outside @ db) @ self._s[:, self._rows_of(f)] for f, db in parts.items()], axis=0)
            across = np.einsum("ktli,tli->kt", da, es @ onto_unknowns)
            both = {i: self._along(es, other) for i, other in counted.items()}
            for f, mine in enumerate(folds):
                curvature[f, j] -= across[:, mine].sum(axis=1)
                curvature[f, :, j] -= across[:, mine].sum(axis=1)
                for i, each in both.items():
                    curvature[f, i, j] += each[mine].sum()
        return gradient, stretch, curvature

    def _rows_of(self, feature: int) -> slice:
        """Where the rows of one feature stand among those of all."""
        rows = self.outside.shape[1]
        return slice(feature * rows, (feature + 1) * rows)

    def _parts(self, dc: Array) -> dict[int, Array]:
        """Matrices (T, L, L) that take each feature to the rows, of coefficients dc (F, L) that are not all zero."""
        return {int(f): dc[f][:, None] * self._takes[:, :, f] for f in np.flatnonzero(np.any(dc, axis=1))}

    def _along(self, es: Array, parts: Mapping[int, Array]) -> Array:
        """Sum (T,) of the products of es (T, L, F L) with the parts of another derivative."""
        return np.asarray(sum(np.einsum("tlk,tlk->t", es[:, :, self._rows_of(f)], db) for f, db in parts.items()))


def _flat(x: Array) -> Array:
    return x.reshape(len(x), -1)
