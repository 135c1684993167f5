"""Parts of an image against a matrix: residual, excess over the noise, and their derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import for_strips
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES, derivatives_of_part, features
from processing.diagnosis.instrument.moments import Block, Moments
from processing.diagnosis.search.space import Sums

#: Singular values below this, relative to the largest, are none.
RANK = 1e-8


def add_response(counts: NDArray[Any], coefficients: Array, a: Array) -> NDArray[Any]:
    """Corrected counts (L, rows, columns) from the coefficients of the features (F, L), as precise as the counts.

    a (L, K) in units of noise.
    """
    if not np.any(coefficients[1:]):
        return counts
    out = np.empty_like(counts)
    plain, around = coefficients[:-DERIVATIVES], coefficients[-DERIVATIVES:]
    fitted = None
    if np.any(around):
        u, size, _ = np.linalg.svd(a, full_matrices=False)
        q = u[:, size > RANK * size[0]].astype(counts.dtype)
        fitted = (q @ (q.T @ counts.reshape(counts.shape[0], -1))).reshape(counts.shape)

    def strip(rows: slice) -> None:
        y = np.einsum("fl,flhw->lhw", plain, features(counts[:, rows].astype(float))[0])
        if fitted is not None:
            y += np.einsum("fl,flhw->lhw", around, derivatives_of_part(fitted, rows, slice(0, counts.shape[2])))
        out[:, rows] = y

    for_strips(counts.shape[1], strip)
    return out


def add_block(
    block: Block, a: Array, c: Array, da: Array, dc: Array | None, moments: Moments, out: Sums, apart: int | None = None
) -> None:
    """Add what a block says of rows a (L, K) and coefficients c (F, L), with their derivatives by each value.

    `apart` : rows of a state, where every state has unknowns of its own; None: all rows have the same unknowns.
    """
    dc = np.zeros((len(da), *c.shape)) if dc is None else dc
    used = np.flatnonzero(np.any(c, axis=1) | np.any(dc, axis=(0, 2)))
    around = used >= len(FEATURES) - DERIVATIVES
    for rows in [block.rows[None]] if apart is None else _by_state(block.rows, apart):
        # Without corrections of the counts, as few pseudo-pixels as there are rows say the same.
        z = block.counts[None, rows] if used.tolist() == [0] else block.z[used][:, rows]
        sigma, noise = moments.sigma[rows], block.noise[rows][:, :, used][..., used]
        part = Projected(
            z.swapaxes(0, 1) / sigma[:, None, :, None],
            noise / (sigma**2)[:, :, None, None],
            a[rows],
            c[used][:, rows].swapaxes(0, 1),
            around,
        )
        slopes = da[:, rows], dc[:, used][:, :, rows].swapaxes(1, 2)
        add_parts(part, *slopes, moments, rows, np.full(len(rows), float(block.pixels)), block.fold, out)


def _by_state(rows: NDArray[np.int64], apart: int) -> list[NDArray[np.int64]]:
    """Rows (T, n) of T states each, of states that have the same number n of them."""
    _, first, number = np.unique(rows // apart, return_index=True, return_counts=True)
    return [rows[first[number == n][:, None] + np.arange(n)] for n in np.unique(number)]


class Projected:
    """Parts of an image, tiles or a whole block, each against a matrix of its own.

    The corrected counts y = c z are joined of features z, of which derivatives are those of the fitted image: the noise
    of one row goes together in all of them, that of two rows does not.

    Attributes
    ----------
    outside : (T, L, L) projection P; residual : (T, L, R) P y; expected : (T,) squares of noise alone.
    """

    def __init__(self, z: Array, noise: Array, a: Array, c: Array, around: NDArray[np.bool_]) -> None:
        """z (T, F, L, R), noise (T, L, F, F), a (T, L, K), c (T or 1, F, L); `around` (F,): which are derivatives."""
        rows = a.shape[1]
        u, size, vt = np.linalg.svd(a, full_matrices=False)
        keep = size > RANK * size[:, :1]
        q = u * keep[:, None, :]
        # A+, turned over.
        self._back = q * np.where(keep, 1 / np.maximum(size, 1e-300), 0.0)[:, None, :] @ vt
        hat = q @ q.transpose(0, 2, 1)
        self.outside = np.eye(rows) - hat
        self._z = z
        if around.any():
            self._z = z.copy()
            self._z[:, around] = hat[:, None] @ z[:, around]
        self._y = np.einsum("tfl,tflr->tlr", c, self._z)
        self.residual = self.outside @ self._y
        # What takes the noise of each feature to the rows, and the mean product of the residual's noise with it.
        takes = np.where(around[:, None], hat[:, :, None], np.eye(rows)[:, None])
        onto = c.swapaxes(1, 2)[..., None] * takes
        left = (self.outside @ onto.reshape(*hat.shape[:2], -1)).reshape(onto.shape)
        mean = (left.transpose(0, 3, 1, 2) @ noise).transpose(0, 2, 3, 1)
        self.expected = np.sum(mean * left, axis=(1, 2, 3))
        self._carried = mean.reshape(*hat.shape[:2], -1) @ onto.reshape(*hat.shape[:2], -1).transpose(0, 2, 1)
        self._of_features = np.sum(takes * mean, axis=3)

    def slopes(self, da: Array, dc: Array) -> tuple[Array, Array, Array]:
        """Half gradient (K,) of the excess and of its noise, and curvature (K, K) of the excess, summed over the parts.

        Of da (K, T, L, K') and dc (K, T or 1, F, L); from dr = -P dA A+ y + P dB z.
        """
        da = self.outside @ da
        y = self._y.transpose(0, 2, 1)
        of_features = self._of_features.swapaxes(1, 2)
        pull = _flat(dc) @ (of_features.sum(axis=0) if dc.shape[1] == 1 else of_features).reshape(-1)
        pull -= _flat(da) @ (self._carried @ self._back).reshape(-1)
        gradient = -pull - _flat(da) @ (self.residual @ y @ self._back).reshape(-1)
        unknowns = y @ self._back
        curvature = _flat(da @ (unknowns.transpose(0, 2, 1) @ unknowns)) @ _flat(da).T
        counted = np.flatnonzero(np.any(dc, axis=(1, 2, 3)))
        if counted.size:
            of_counts = np.stack([self.outside @ self._weighted(dc[j]) for j in counted])
            gradient[counted] += _flat(of_counts) @ self.residual.reshape(-1)
            across = _flat(of_counts @ unknowns) @ _flat(da).T
            curvature[counted] -= across
            curvature[:, counted] -= across.T
            curvature[np.ix_(counted, counted)] += _flat(of_counts) @ _flat(of_counts).T
        return gradient, pull, curvature

    def of_each(self, da: Array) -> tuple[Array, Array]:
        """Half gradient (T,) of the excess of each part by one value, and its curvature (T,), of da (L, K')."""
        da = self.outside @ da
        unknowns = self._y.transpose(0, 2, 1) @ self._back
        gradient = np.sum(da * (self._carried @ self._back - self.residual @ unknowns), axis=(1, 2))
        return gradient, np.sum((da @ unknowns.transpose(0, 2, 1)) ** 2, axis=(1, 2))

    def _weighted(self, c: Array) -> Array:
        """Sum (T, L, R) of the features, each times its coefficient (T or 1, F, L)."""
        used = np.flatnonzero(np.any(c, axis=(0, 2)))
        return np.asarray(np.einsum("tfl,tflr->tlr", c[:, used], self._z[:, used]))


def add_parts(
    parts: Projected,
    da: Array,
    dc: Array,
    moments: Moments,
    rows: NDArray[np.int64],
    pixels: NDArray[np.floating],
    fold: int,
    out: Sums,
) -> None:
    """Add what parts of one fold say, with derivatives da (K, T, L, K') and dc (K, T or 1, F, L).

    `rows` (T or 1, L) : of each part; `pixels` (T,) : how many stand behind it.
    """
    squares, left = np.sum(parts.residual**2, axis=2), float(parts.expected.sum())
    free = pixels[:, None] * np.diagonal(parts.outside, axis1=1, axis2=2)
    out.excess[fold] += squares.sum() - left
    out.freedom[fold] += left
    out.square[fold] += np.sum(squares * moments.sigma[rows] ** 2) * moments.relative
    out.count[fold] += np.sum(free * moments.left[rows])
    if len(da):
        gradient, stretch, curvature = parts.slopes(da, dc)
        out.gradient[fold] += gradient
        out.stretch[fold] += stretch
        out.curvature[fold] += curvature


def noise_information(block: Block, a: Array, dc: Array, moments: Moments) -> Array:
    """Part (K, K) of the curvature that comes from the noise of image derivatives and tells nothing about the values.

    Of rows a (L, K) in units of their noise and derivatives dc (K, F, L) of the coefficients by the values.
    """
    rows, out = block.rows, np.zeros((len(dc), len(dc)))
    moving = np.flatnonzero(np.any(dc[:, -DERIVATIVES:, rows], axis=(1, 2)))
    if not moving.size:
        return out
    u, size, _ = np.linalg.svd(a[rows], full_matrices=False)
    q = u[:, size > RANK * size[0]]
    hat = q @ q.T
    noise = block.noise[rows, -DERIVATIVES:, -DERIVATIVES:] / moments.sigma[rows, None, None] ** 2
    # P diag(dc) Q Q^T for each value and derivative.
    into = dc[moving, -DERIVATIVES:][:, :, rows, None] * hat
    into -= hat @ into
    out[np.ix_(moving, moving)] = np.einsum("ielk,keh,jhlk->ij", into, noise, into, optimize=True)
    return out


def _flat(x: Array) -> Array:
    return x.reshape(len(x), -1)
