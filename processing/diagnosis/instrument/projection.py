"""One block of pixels against a matrix: residual, excess over the noise, and their derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import for_strips
from processing.diagnosis.instrument.features import DERIVATIVES, derivatives_of_part, features
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


def add_block(block: Block, a: Array, c: Array, da: Array, dc: Array | None, moments: Moments, out: Sums) -> None:
    """Add what a block says of rows a (L, K) and coefficients c (F, L), with their derivatives by each value."""
    rows = block.rows
    scale = 1 / moments.sigma[rows]
    c, da = c[:, rows], da[:, rows]
    dc = None if dc is None or not np.any(dc) else dc[:, :, rows]
    # Without corrections of the counts, as few pseudo-pixels as there are rows say the same.
    plain = dc is None and not np.any(c[1:])
    z = block.counts[None, rows] if plain else block.z[:, rows]
    u, size, vt = np.linalg.svd(a[rows], full_matrices=False)
    keep = size > RANK * size[0]
    q = u[:, keep]
    around = bool(np.any(c[-DERIVATIVES:])) or (dc is not None and bool(np.any(dc[:, -DERIVATIVES:])))
    if around:
        # Derivatives of the fitted image in place of those of the noisy frames.
        z = np.concatenate([z[:-DERIVATIVES], q @ (q.T @ (z[-DERIVATIVES:] * scale[:, None])) / scale[:, None]])
    noise = _Noise(block.noise[rows] * scale[:, None, None] ** 2, c, q, around)
    y = _weighted_sum(c, z) * scale[:, None]
    pinv = (vt[keep].T / size[keep]) @ q.T
    r = y - q @ (q.T @ y)
    f = block.fold
    out.freedom[f] += noise.left
    out.excess[f] += float(np.sum(r * r)) - noise.left
    out.square[f] += float(np.sum((r / scale[:, None]) ** 2)) * moments.relative
    out.count[f] += (1 - np.sum(q * q, axis=1)) @ moments.left[rows] * block.pixels
    if da.shape[0] == 0:
        return
    k = da.shape[0]
    d = -(da.reshape(-1, a.shape[1]) @ (pinv @ y)).reshape(k, rows.size, -1)
    pull = -np.einsum("kli,il->k", da, pinv @ noise.carried)
    if dc is not None:
        for j in np.flatnonzero(np.any(dc, axis=(1, 2))):
            d[j] += _weighted_sum(dc[j], z) * scale[:, None]
            pull[j] += noise.along(dc[j])
    d -= q @ (q.T @ d)
    flat = d.reshape(k, -1)
    out.gradient[f] += flat @ r.reshape(-1) - pull
    out.stretch[f] += pull
    out.curvature[f] += flat @ flat.T


class _Noise:
    """What the noise of the pixels is expected to give in the products of a block.

    The corrected counts y have the noise sum over e of A_e n_e: n_0 is that of all features that need no neighbours,
    as the coefficients join them, with A_0 the identity; n_1 to n_5 that of the derivatives, of which the fitted image
    has the part A_e = diag(c_e) Q Q^T. The noises of one row go together, those of two rows do not.

    Attributes
    ----------
    left : sum of squares of the residual; carried : (L, L) mean of y times residual.
    """

    def __init__(self, noise: Array, c: Array, q: Array, around: bool) -> None:
        """`noise` (L, F, F) of products of features, in weighted units; c (F, L); q (L, rank)."""
        rows = len(noise)
        self._hat = q @ q.T
        outside = np.eye(rows) - self._hat
        joined = np.zeros((1 + DERIVATIVES * around, *c.shape))
        joined[0, :-DERIVATIVES] = c[:-DERIVATIVES]
        for e in range(1, len(joined)):
            joined[e, e - 1 - DERIVATIVES] = 1.0
        with_features = np.einsum("efl,lfg->elg", joined, noise)
        among = np.einsum("elg,hgl->leh", with_features, joined)
        into = np.stack([np.eye(rows), *(c[e - 1 - DERIVATIVES, :, None] * self._hat for e in range(1, len(joined)))])
        residual = outside @ into
        # Mean of residual (L, .) times n_e of a row (., L).
        mean = np.einsum("elk,keh->hlk", residual, among)
        self.left = float(np.sum(mean * residual))
        self.carried = np.einsum("elk,emk->lm", into, mean)
        self._of_features = np.einsum("ell,elg->lg", residual, with_features)
        self._of_derivatives = mean[1:]

    def along(self, dc: Array) -> float:
        """Sum of residual times a change of the corrected counts by coefficients dc (F, L)."""
        out = np.sum(dc[:-DERIVATIVES] * self._of_features.T[:-DERIVATIVES])
        for e, mean in enumerate(self._of_derivatives):
            out += np.sum(dc[e - DERIVATIVES, :, None] * self._hat * mean)
        return float(out)


def noise_information(block: Block, a: Array, dc: Array, moments: Moments) -> Array:
    """Part (K, K) of the curvature that comes from the noise of image derivatives and tells nothing about the values.

    Of rows a (L, K) in units of their noise and derivatives dc (K, F, L) of the coefficients by the values.
    """
    rows = block.rows
    u, size, _ = np.linalg.svd(a[rows], full_matrices=False)
    q = u[:, size > RANK * size[0]]
    hat = q @ q.T
    noise = block.noise[rows, -DERIVATIVES:, -DERIVATIVES:] / moments.sigma[rows, None, None] ** 2
    # P diag(dc) Q Q^T for each value and derivative.
    into = dc[:, -DERIVATIVES:, rows, None] * hat
    into -= hat @ into
    return np.asarray(np.einsum("ielk,keh,jhlk->ij", into, noise, into, optimize=True))


def _weighted_sum(c: Array, z: Array) -> Array:
    used = np.flatnonzero(np.any(c != 0, axis=1))
    return np.asarray(sum(c[f][:, None] * z[f] for f in used))
