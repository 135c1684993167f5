"""One block of pixels against a matrix: residual, excess over the noise, and their derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.diagnosis.moments import DERIVATIVES, Block, Moments, features, image_derivatives
from processing.diagnosis.space import Sums

Array = NDArray[np.float64]
#: Singular values below this, relative to the largest, are none.
RANK = 1e-8


def add_response(counts: Array, coefficients: Array, a: Array) -> Array:
    """Corrected counts (L, rows, columns) from the coefficients of the features (F, L); a (L, K) in units of noise."""
    if not np.any(coefficients[1:]):
        return counts
    z, _ = features(counts)
    if np.any(coefficients[-DERIVATIVES:]):
        u, size, _ = np.linalg.svd(a, full_matrices=False)
        q = u[:, size > RANK * size[0]]
        fitted = (q @ (q.T @ counts.reshape(counts.shape[0], -1))).reshape(counts.shape)
        z[-DERIVATIVES:] = image_derivatives(fitted)
    return np.asarray(np.einsum("fl,flhw->lhw", coefficients, z))


def add_block(block: Block, a: Array, c: Array, da: Array, dc: Array | None, moments: Moments, out: Sums) -> None:
    rows = block.rows
    scale = 1 / moments.sigma[rows]
    # Without corrections of the counts, as few pseudo-pixels as there are rows say the same.
    plain = not np.any(c[1:]) and (dc is None or not np.any(dc))
    z, noise = (block.counts[None, rows] if plain else block.z[:, rows]), block.noise[rows]
    u, size, vt = np.linalg.svd(a[rows], full_matrices=False)
    keep = size > RANK * size[0]
    q = u[:, keep]
    if not plain and (np.any(c[-DERIVATIVES:]) or (dc is not None and np.any(dc[:, -DERIVATIVES:]))):
        z, noise = _smooth_derivatives(z, noise, q, scale)
    y = _weighted_sum(c[:, rows], z) * scale[:, None]
    cn = np.einsum("lfg,gl->lf", noise, c[:, rows])
    n = np.einsum("fl,lf->l", c[:, rows], cn) * scale**2
    pinv = (vt[keep].T / size[keep]) @ q.T
    r = y - q @ (q.T @ y)
    free = 1 - np.sum(q * q, axis=1)
    f = block.fold
    out.freedom[f] += free @ n
    out.excess[f] += float(np.sum(r * r)) - free @ n
    out.square[f] += float(np.sum((r / scale[:, None]) ** 2)) * moments.relative
    out.count[f] += free @ moments.left[rows] * block.pixels
    if dc is None or da.shape[0] == 0:
        return
    k = da.shape[0]
    d = -(da[:, rows].reshape(-1, a.shape[1]) @ (pinv @ y)).reshape(k, rows.size, -1)
    noise_term = np.zeros(k)
    counted = np.flatnonzero(np.any(dc != 0, axis=(1, 2)))
    for j in counted:
        d[j] += _weighted_sum(dc[j][:, rows], z) * scale[:, None]
        noise_term[j] += np.sum(free * np.einsum("fl,lf->l", dc[j][:, rows], cn) * scale**2)
    d -= q @ (q.T @ d)
    b = np.einsum("kli,il->kl", da[:, rows], pinv)
    qb = np.einsum("lr,kri,il->kl", q, np.einsum("lr,kli->kri", q, da[:, rows], optimize=True), pinv, optimize=True)
    noise_term -= np.einsum("kl,l->k", b - qb, n)
    flat = d.reshape(k, -1)
    out.gradient[f] += flat @ r.reshape(-1) - noise_term
    out.curvature[f] += flat @ flat.T


def _smooth_derivatives(z: Array, noise: Array, q: Array, scale: Array) -> tuple[Array, Array]:
    """Derivatives of the fitted image in place of those of the noisy frames, and the noise that is left in them."""
    z, noise = z.copy(), noise.copy()
    hat = q @ q.T
    relative = scale[None, :] / scale[:, None]
    for f in range(-DERIVATIVES, 0):
        z[f] = (hat @ (z[f] * scale[:, None])) / scale[:, None]
        # The fitted image has the noise that the projection takes away: none is shared with what it leaves.
        noise[:, :-DERIVATIVES, f] = noise[:, f, :-DERIVATIVES] = 0.0
        for g in range(-DERIVATIVES, 0):
            noise[:, f, g] = (hat * relative) ** 2 @ noise[:, f, g] if f <= g else noise[:, g, f]
    return z, noise


def _weighted_sum(c: Array, z: Array) -> Array:
    used = np.flatnonzero(np.any(c != 0, axis=1))
    return np.asarray(sum(c[f][:, None] * z[f] for f in used))
