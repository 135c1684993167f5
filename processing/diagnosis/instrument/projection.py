"""Parts of an image against a matrix: residual, excess over the noise, and their derivatives.

The noise of feature f of row l reaches the corrected counts as c_f n_f, or as c_f H n_f where f is a derivative, which
is one of the fitted image (H = Q Q^T); the residual is P of that. Q is much narrower than H, so products go through it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captures.capture_data import for_strips
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES, derivatives_of_part, features
from processing.diagnosis.instrument.moments import Block, Moments
from processing.diagnosis.search.range_of import RANK, range_of
from processing.diagnosis.search.space import Sums
from processing.instrument.changes import places


class NoiseOfParts:
    """Noise of T parts of an image, each projected with a matrix of its own.

    Attributes
    ----------
    free : (T, L) diagonal of the projection P.
    of_features : (T, F, L) mean product of the residual's noise with that of each feature, as it reaches each row.
    """

    def __init__(self, noise: Array, q: Array, c: Array, *, around: NDArray[np.bool_]) -> None:
        """noise (T, L, F, F), q (T, L, K), c (T or 1, F, L); `around` (F,): which features are derivatives."""
        self._noise, self._q, self.free = noise, q, 1 - np.sum(q * q, axis=2)
        self._plain, self._around = np.flatnonzero(~around), np.flatnonzero(around)
        self._moving = self._around[np.any(c[:, self._around], axis=(0, 2))]
        self._c = c.swapaxes(1, 2)
        # (T, L, F): the noise of each feature with that of the features of the pixel itself, as they are joined.
        self._joined = np.einsum("tlg,tlfg->tlf", self._c[..., self._plain], noise[..., self._plain])
        self.of_features = self._of_features().swapaxes(1, 2)

    def _of_features(self) -> Array:
        noise_of = np.asarray(self.free[..., None] * self._joined)
        if not self._around.size:
            return noise_of
        hat = self._q @ self._q.transpose(0, 2, 1)
        noise_of[..., self._around] = (hat * _outside(hat)) @ self._joined[..., self._around]
        if self._moving.size:
            narrow = _off(self._q[:, None], self._q[:, None] * self._by_feature(self._c[..., self._moving]))
            # (T, M, L, L): from the noise of each row to the residual, by way of each derivative.
            takes = narrow @ self._q.transpose(0, 2, 1)[:, None]
            noise = self._noise[..., self._moving]
            direct = np.diagonal(takes, axis1=2, axis2=3).swapaxes(1, 2)
            noise_of[..., self._plain] += np.einsum("tlm,tlfm->tlf", direct, noise[:, :, self._plain])
            # One product over rows and derivatives.
            wide = (hat[:, None] * takes).swapaxes(1, 2).reshape(*hat.shape[:2], -1)
            of_around = noise[:, :, self._around].transpose(0, 3, 1, 2)
            noise_of[..., self._around] += wide @ of_around.reshape(len(hat), -1, self._around.size)
        return noise_of

    def carried(self, back: Array) -> Array:
        """Mean product (T, L, L) of the residual's noise with that of the counts, times back (T, L, K)."""
        plain, moving = self._plain, self._moving
        product = np.sum(self._c[..., plain] * self._joined[..., plain], axis=2)[..., None] * back
        if moving.size:
            c = self._by_feature(self._c[..., moving])
            back_of = fitted(self._q[:, None], c * back[:, None])
            joined = self._by_feature(self._joined[..., moving])
            product += np.sum(joined * back_of, axis=1)
            noise = self._noise[:, :, moving][..., moving]
            total = joined * back[:, None] + np.einsum("tlfg,tflk->tglk", noise, back_of)
            product += np.sum(c * fitted(self._q[:, None], total), axis=1)
        return _off(self._q, product)

    @staticmethod
    def _by_feature(x: Array) -> Array:
        """(T, M, L, 1) of (T, L, M)."""
        return np.asarray(x.swapaxes(1, 2)[..., None])


def fitted(q: Array, x: Array) -> Array:
    """Q Q^T x (..., L, R) of orthonormal directions q (..., L, K)."""
    return np.asarray(q @ (q.swapaxes(-1, -2) @ x))


def _off(q: Array, x: Array) -> Array:
    """P x (..., L, R) of the same, with P = 1 - Q Q^T."""
    return np.asarray(x - fitted(q, x))


def _outside(hat: Array) -> Array:
    """P (..., L, L) of H = Q Q^T (..., L, L)."""
    return np.asarray(np.eye(hat.shape[-1]) - hat)


def add_response(counts: NDArray[Any], coefficients: Array, a: Array) -> NDArray[Any]:
    """Corrected counts (L, rows, columns) from the coefficients of the features (F, L), as precise as the counts.

    a (L, K) in units of noise.
    """
    if not np.any(coefficients[1:]):
        return counts
    result = np.empty_like(counts)
    plain, around = coefficients[:-DERIVATIVES], coefficients[-DERIVATIVES:]
    fitted = None
    if np.any(around):
        q = range_of(a).astype(counts.dtype)
        fitted = (q @ (q.T @ counts.reshape(counts.shape[0], -1))).reshape(counts.shape)

    x, y = places(*counts.shape[1:])

    def strip(rows: slice) -> None:
        part = features(counts[:, rows].astype(float), x[rows], y[rows])[0]
        corrected = np.einsum("fl,flhw->lhw", plain, part)
        if fitted is not None:
            corrected += np.einsum("fl,flhw->lhw", around, derivatives_of_part(fitted, rows, slice(0, counts.shape[2])))
        result[:, rows] = corrected

    for_strips(counts.shape[1], strip)
    return result


def response_slopes(counts: NDArray[Any], coefficients: Array) -> NDArray[Any] | None:
    """Slope (L, rows, columns) of corrected counts by the counts, which the noise follows; None where it is one."""
    plain = coefficients[:-DERIVATIVES]
    if not np.any(plain[1:]):
        return None
    slopes, (x, y) = np.empty_like(counts), places(*counts.shape[1:])

    def strip(rows: slice) -> None:
        of_features = features(counts[:, rows].astype(float), x[rows], y[rows])[1]
        slopes[:, rows] = np.einsum("fl,flhw->lhw", plain, of_features)

    for_strips(counts.shape[1], strip)
    return slopes


def add_blocks(
    blocks: Sequence[Block],
    a: Array,
    c: Array,
    da: Array,
    *,
    dc: Array | None,
    moments: Moments,
    out: Sums,
    apart: int | None = None,
) -> None:
    """Add what blocks of the same pixels say of rows a (L, K) and coefficients c (F, L), with their derivatives.

    `apart` : rows of a state, where every state has unknowns of its own; None: all rows have the same unknowns.
    """
    dc, block = np.zeros((len(da), *c.shape)) if dc is None else dc, blocks[0]
    used = np.flatnonzero(np.any(c, axis=1) | np.any(dc, axis=(0, 2)))
    around, dc_used = used >= len(FEATURES) - DERIVATIVES, dc[:, used]
    for rows, fold in _of_each(blocks) if apart is None else _by_state(blocks, apart):
        # Without corrections of the counts, as few pseudo-pixels as there are rows say the same.
        z = block.counts[None, rows] if used.tolist() == [0] else block.z[used][:, rows]
        sigma, noise = moments.sigma[rows], block.noise[rows[..., None, None], used[:, None], used]
        parts = Projected(
            z.swapaxes(0, 1) / sigma[:, None, :, None],
            noise / (sigma**2)[:, :, None, None],
            a[rows],
            c[used][:, rows].swapaxes(0, 1),
            around=around,
        )
        add_parts(parts, moments, rows, np.full(len(rows), float(block.pixels)), fold=fold, out=out)
        for f in np.unique(fold) if len(da) else ():
            some = np.flatnonzero(fold == f)
            own, of_fold = rows[some], parts if some.size == fold.size else parts.among(some)
            gradient, stretch, curvature = of_fold.slopes(da[:, own], dc_used[:, :, own].swapaxes(1, 2))
            out.gradient[f] += gradient
            out.stretch[f] += stretch
            out.curvature[f] += curvature


def _of_each(blocks: Sequence[Block]) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Rows (1, L) and fold (1,) of each block."""
    for block in blocks:
        yield block.rows[None], np.array([block.fold])


def _by_state(blocks: Sequence[Block], apart: int) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Rows (T, n) and folds (T,) of T states each, of states that have the same number n of rows."""
    rows = np.concatenate([b.rows for b in blocks])
    fold = np.repeat([b.fold for b in blocks], [b.rows.size for b in blocks])
    rows, fold = rows[order := np.argsort(rows)], fold[order]
    _, first, number = np.unique(rows // apart, return_index=True, return_counts=True)
    for n in np.unique(number):
        at = first[number == n]
        yield rows[at[:, None] + np.arange(n)], fold[at]


class Projected:
    """Parts of an image, tiles or a whole block, each against a matrix of its own.

    The corrected counts y = c z are joined of features z, of which derivatives are those of the fitted image: the noise
    of one row goes together in all of them, that of two rows does not.

    Attributes
    ----------
    free : (T, L) diagonal of the projection P; residual : (T, L, R) P y; expected : (T,) squares of noise alone.
    unknowns : (T, R, K) A+ y, turned over.
    of_features : (T, F, L) see `NoiseOfParts`.
    """

    def __init__(self, z: Array, noise: Array, a: Array, c: Array, *, around: NDArray[np.bool_]) -> None:
        """z (T, F, L, R), noise (T, L, F, F), a (T, L, K), c (T or 1, F, L); `around` (F,): which are derivatives."""
        u, size, vt = np.linalg.svd(a, full_matrices=False)
        keep = size > RANK * size[:, :1]
        q = u * keep[:, None, :]
        # A+, turned over.
        self._back = q * np.where(keep, 1 / np.maximum(size, 1e-300), 0.0)[:, None, :] @ vt
        self._q, self._z = q, z
        self._noise = NoiseOfParts(noise, q, c, around=around)
        self.free, self.of_features = self._noise.free, self._noise.of_features
        if around.any():
            self._z = z.copy()
            self._z[:, around] = fitted(q[:, None], z[:, around])
        y = np.einsum("tfl,tflr->tlr", c, self._z)
        self.residual, self.unknowns = _off(q, y), y.transpose(0, 2, 1) @ self._back
        self.expected = np.sum(c * self.of_features, axis=(1, 2))

    @cached_property
    def outside(self) -> Array:
        """Projection P (T, L, L)."""
        return _outside(self._q @ self._q.transpose(0, 2, 1))

    @cached_property
    def by_rows(self) -> tuple[Array, Array]:
        """Half gradients (T, L, K) by a: of the excess, and of its noise."""
        carried = self._noise.carried(self._back)
        return carried - self.residual @ self.unknowns, -carried

    def among(self, some: NDArray[np.int64]) -> Projected:
        """Some of the parts."""
        few = copy(self)
        for name in ("_q", "_z", "free", "residual", "unknowns", "expected", "of_features"):
            setattr(few, name, getattr(self, name)[some])
        few.by_rows = self.by_rows[0][some], self.by_rows[1][some]
        return few

    def pull_of_counts(self, dc: Array) -> Array:
        """Half gradient (K,) of the noise by what changes the coefficients, dc (K, T or 1, F, L)."""
        of_features = self.of_features
        return np.asarray(_flat(dc) @ (of_features.sum(axis=0) if dc.shape[1] == 1 else of_features).reshape(-1))

    def moved_by_counts(self, dc: Array) -> Array:
        """Change (T, L, R) of the residual by dc (T or 1, F, L) of one value."""
        used = np.flatnonzero(np.any(dc, axis=(0, 2)))
        return _off(self._q, np.einsum("tfl,tflr->tlr", dc[:, used], self._z[:, used]))

    def slopes(self, da: Array, dc: Array) -> tuple[Array, Array, Array]:
        """Half gradient (K,) of the excess and of its noise, and curvature (K, K) of the excess, summed over the parts.

        Of da (K, T, L, K') and dc (K, T or 1, F, L); from dr = -P dA A+ y + P dB z.
        """
        da = _off(self._q, da)
        pull, gradient = (_flat(da) @ by_rows.reshape(-1) for by_rows in self.by_rows[::-1])
        unknowns = self.unknowns
        curvature = _flat(da @ (unknowns.transpose(0, 2, 1) @ unknowns)) @ _flat(da).T
        counted = np.flatnonzero(np.any(dc, axis=(1, 2, 3)))
        if counted.size:
            of_counts = np.stack([self.moved_by_counts(dc[j]) for j in counted])
            pull_of_counts = self.pull_of_counts(dc[counted])
            pull[counted] += pull_of_counts
            gradient[counted] += _flat(of_counts) @ self.residual.reshape(-1) - pull_of_counts
            across = _flat(of_counts @ unknowns) @ _flat(da).T
            curvature[counted] -= across
            curvature[:, counted] -= across.T
            curvature[np.ix_(counted, counted)] += _flat(of_counts) @ _flat(of_counts).T
        return gradient, pull, curvature

    def of_each(self, da: Array, dc: Array) -> tuple[Array, Array]:
        """Half gradient (T,) of the excess of each part by one value, and its curvature (T,).

        Of da (L, K') and dc (F, L), as in `slopes`.
        """
        by_counts = self.moved_by_counts(dc[None])
        da = _off(self._q, da)
        gradient = np.sum(da * self.by_rows[0], axis=(1, 2)) + np.sum(by_counts * self.residual, axis=(1, 2))
        gradient -= np.sum(dc * self.of_features, axis=(1, 2))
        return gradient, np.sum((by_counts - da @ self.unknowns.transpose(0, 2, 1)) ** 2, axis=(1, 2))


def add_parts(
    parts: Projected,
    moments: Moments,
    rows: NDArray[np.int64],
    pixels: NDArray[np.floating],
    *,
    fold: NDArray[np.int64],
    out: Sums,
) -> None:
    """Add what parts leave.

    `rows` (T or 1, L) : of each part; `pixels` (T,) : how many stand behind it; `fold` (T,).
    """
    squares = np.sum(parts.residual**2, axis=2)
    for total, each in (
        (out.excess, squares.sum(axis=1) - parts.expected),
        (out.freedom, parts.expected),
        (out.square, np.sum(squares * moments.sigma[rows] ** 2, axis=1) * moments.relative),
        (out.count, pixels * np.sum(parts.free * moments.shown[rows], axis=1)),
    ):
        np.add.at(total, fold, each)


def noise_information(block: Block, a: Array, dc: Array, moments: Moments) -> tuple[Array, Array]:
    """Parts (K, K) of the curvature that the noise of image derivatives makes, and the noise of the counts themselves.

    Of rows a (L, K) in units of their noise and derivatives dc (K, F, L) of the coefficients by the values.
    """
    rows, (of_derivatives, of_counts) = block.rows, np.zeros((2, len(dc), len(dc)))
    counted = np.flatnonzero(np.any(dc, axis=(1, 2)))
    q = range_of(a[rows])
    hat = q @ q.T
    noise = block.noise[rows] / moments.sigma[rows, None, None] ** 2
    plain, around = dc[counted, :-DERIVATIVES][..., rows], dc[:, -DERIVATIVES:][..., rows]
    carried = np.einsum("kfl,lfg->klg", plain * (1 - np.diagonal(hat)), noise[:, :-DERIVATIVES, :-DERIVATIVES])
    of_counts[np.ix_(counted, counted)] = _flat(carried) @ _flat(plain.swapaxes(1, 2)).T
    if (moving := np.flatnonzero(np.any(around, axis=(1, 2)))).size:
        # P diag(dc) Q Q^T for each value and derivative.
        into = around[moving, :, :, None] * hat
        into -= hat @ into
        noise = noise[:, -DERIVATIVES:, -DERIVATIVES:]
        of_derivatives[np.ix_(moving, moving)] = np.einsum("ielk,keh,jhlk->ij", into, noise, into, optimize=True)
    return of_derivatives, of_counts


def _flat(x: Array) -> Array:
    return x.reshape(len(x), math.prod(x.shape[1:]))
