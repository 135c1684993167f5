"""Symmetric decomposition: M = MD2 MR2 Mdelta MR1^T MD1, with a diagonal depolarizer between two pure sides.

Ossikovski, J. Opt. Soc. Am. A 26, 1109 (2009). The two diattenuators come from the eigenvectors of M^T G M G and
M G M^T G, G = diag(1, -1, -1, -1), the retarders from a singular value decomposition of what is left.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from processing.arrays import RealArray

G = np.diag([1.0, -1.0, -1.0, -1.0])
#: Relative distance of the two largest eigenvalues below which their eigenvectors are arbitrary: a pure matrix.
SMALLEST_GAP = 1e-9
#: 1 - |D|^2 of an eigenvector below this counts as |D| = 1, where the decomposition has another form.
SMALLEST_REST = 1e-10


class Symmetric(NamedTuple):
    """M = diattenuator_2 @ retarder_2 @ depolarizer @ retarder_1.T @ diattenuator_1; NaN where not defined."""

    diattenuator_2: RealArray
    """(..., 4, 4), symmetric, m00 = 1: the side where the light leaves."""
    retarder_2: RealArray
    """(..., 4, 4), rotation."""
    depolarizer: RealArray
    """(..., 4, 4), diagonal diag(d0, d1, d2, d3) with d1 >= d2 >= |d3|; d3 carries the sign of det M."""
    retarder_1: RealArray
    """(..., 4, 4), rotation."""
    diattenuator_1: RealArray
    """(..., 4, 4), symmetric, m00 = 1: the side where the light enters."""
    defined: NDArray[np.bool_]
    """(...): both eigenvectors are Stokes vectors with |D| < 1 (the Stokes diagonalizable case)."""


def symmetric(m: RealArray) -> Symmetric:
    """Symmetric decomposition of Mueller matrices (..., 4, 4).

    Not defined for matrices that no such product gives (a polarizer, Stokes-non-diagonalizable matrices), for
    unphysical ones, and for pure ones, where the split between the two sides is arbitrary; `defined` says where.
    Equal diagonal elements leave the two retarders a common freedom.
    """
    m = np.asarray(m, dtype=float)
    finite = np.isfinite(m).all(axis=(-2, -1)) & (m[..., 0, 0] > 0)
    safe = np.where(finite[..., None, None], m, np.eye(4))
    transposed = np.swapaxes(safe, -1, -2)
    d1, good1 = _eigen_diattenuation(transposed @ G @ safe @ G)
    d2, good2 = _eigen_diattenuation(safe @ G @ transposed @ G)
    defined = finite & good1 & good2
    d1, d2 = (np.where(defined[..., None], d, 0.0) for d in (d1, d2))
    core = np.linalg.inv(_diattenuator(d2)) @ safe @ np.linalg.inv(_diattenuator(d1))
    u, s, vt = np.linalg.svd(core[..., 1:, 1:])
    # Both rotations get det +1; what that costs goes to the smallest element.
    sign_u, sign_v = np.linalg.det(u), np.linalg.det(vt)
    u[..., :, 2] *= sign_u[..., None]
    vt[..., 2, :] *= sign_v[..., None]
    s[..., 2] *= sign_u * sign_v
    diagonal = np.concatenate([core[..., :1, 0], s], axis=-1)
    factors = (
        _diattenuator(d2),
        _embed(u),
        diagonal[..., :, None] * np.eye(4),
        _embed(np.swapaxes(vt, -1, -2)),
        _diattenuator(d1),
    )
    d2, r2, depolarizer, r1, d1 = (np.where(defined[..., None, None], f, np.nan) for f in factors)
    return Symmetric(d2, r2, depolarizer, r1, d1, defined)


def noise_of_core(found: Symmetric, covariance: RealArray) -> NDArray[np.float64]:
    """Root mean square error (...) of the nine elements between the diattenuators, over element 0 of the depolarizer.

    Their singular values are the other elements. The retarders turn the nine, which changes no mean of squares.

    Parameters
    ----------
    covariance : (..., 16, 16), of the elements of the matrix.
    """
    weights = []
    for d in (found.diattenuator_2, found.diattenuator_1):
        inverse = (G @ d @ G)[..., 1:, :] / (1 - np.sum(np.square(d[..., 0, 1:]), axis=-1))[..., None, None]
        weights.append(np.swapaxes(inverse, -1, -2) @ inverse)
    each = covariance.reshape(*covariance.shape[:-2], 4, 4, 4, 4)
    total = np.einsum("...ac,...bd,...abcd->...", *weights, each, optimize=True)
    return np.asarray(np.sqrt(total) / 3 / found.depolarizer[..., 0, 0], dtype=float)


def _eigen_diattenuation(n: RealArray) -> tuple[RealArray, NDArray[np.bool_]]:
    """Vector part D of the eigenvector (1, D) of the largest eigenvalue, and whether it is a Stokes vector."""
    values, vectors = np.linalg.eig(n)
    # In the sense of the cone of Stokes vectors the largest eigenvalue is real; noise may spoil that.
    largest = np.argmax(values.real, axis=-1)[..., None]
    ordered = np.sort(values.real, axis=-1)
    value = np.take_along_axis(values, largest, axis=-1)[..., 0]
    vector = np.take_along_axis(vectors, largest[..., None], axis=-1)[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        d = vector[..., 1:] / vector[..., :1]
        real = np.abs(value.imag) <= 1e-9 * np.abs(value.real)
        rest = 1 - np.sum(np.abs(d) ** 2, axis=-1)
        apart = ordered[..., -1] - ordered[..., -2] > SMALLEST_GAP * ordered[..., -1]
        good = real & apart & (value.real > 0) & (rest > SMALLEST_REST) & (np.abs(d.imag).max(axis=-1) < 1e-7)
    return np.asarray(d.real), good


def _diattenuator(d: RealArray) -> RealArray:
    """Normalized diattenuator (..., 4, 4) of diattenuation vectors d (..., 3)."""
    q = np.sqrt(1 - np.sum(d * d, axis=-1))[..., None, None]
    out = np.empty((*d.shape[:-1], 4, 4))
    out[..., 0, 0] = 1
    out[..., 0, 1:] = out[..., 1:, 0] = d
    out[..., 1:, 1:] = q * np.eye(3) + d[..., :, None] * d[..., None, :] / (1 + q)
    return out


def _embed(rotation: RealArray) -> RealArray:
    out = np.zeros((*rotation.shape[:-2], 4, 4))
    out[..., 0, 0] = 1
    out[..., 1:, 1:] = rotation
    return out
