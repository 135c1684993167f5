"""Differential decomposition: the matrix logarithm of M, split into mean properties and depolarization.

Ossikovski, Opt. Lett. 36, 2330 (2011): L = ln M, Lm = (L - G L^T G) / 2 holds diattenuation and retardance, Lu =
(L + G L^T G) / 2 the depolarization that the medium builds up. For a medium that is uniform along the beam.
"""

import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from processing.arrays import RealArray

G = np.diag([1.0, -1.0, -1.0, -1.0])
#: Condition number of the eigenvectors above which the logarithm is computed by scipy, one matrix at a time.
WORST_EIGENVECTORS = 1e5


class Differential(NamedTuple):
    """Parts of L = ln M = mean + fluctuation; NaN where not defined."""

    mean: RealArray
    """(..., 4, 4): Lm, G-antisymmetric: diattenuation and retardance; its diagonal is ln of the throughput."""
    fluctuation: RealArray
    """(..., 4, 4): Lu, G-symmetric, 00 element zero: depolarization."""
    defined: NDArray[np.bool_]
    """(...): no eigenvalue of M on the closed negative real axis, so the real logarithm exists and is unique."""

    def diattenuation(self) -> RealArray:
        """Vector (..., 3): ln of the amplitude ratio along each Stokes axis; |.| = ln(T_max / T_min) / 2."""
        return np.asarray(self.mean[..., 0, 1:])

    def retardance(self) -> RealArray:
        """Vector (..., 3), radians, along the fast state: horizontal, 45 degrees, right circular (as Lu-Chipman)."""
        m = self.mean
        return np.stack([m[..., 2, 3], m[..., 3, 1], m[..., 1, 2]], axis=-1)

    def depolarization(self) -> RealArray:
        """Diagonal (..., 3) of -Lu: decay exponents of S1, S2 and S3; not below 0 for a physical medium."""
        return np.stack([-self.fluctuation[..., k, k] for k in (1, 2, 3)], axis=-1)


def differential(m: RealArray) -> Differential:
    """Differential decomposition of Mueller matrices (..., 4, 4).

    A retardance above 180 degrees comes back as the shorter way round: the principal logarithm cannot tell.
    """
    m = np.asarray(m, dtype=float)
    usable = np.isfinite(m).all(axis=(-2, -1)) & (m[..., 0, 0] > 0)
    flat = np.where(usable[..., None, None], m, np.eye(4)).reshape(-1, 4, 4)
    values, vectors = np.linalg.eig(flat)
    size = np.abs(values).max(axis=-1, keepdims=True)
    on_cut = (values.real <= 1e-12 * size) & (np.abs(values.imag) <= 1e-12 * size)
    defined = usable.reshape(-1) & ~on_cut.any(axis=-1)
    logs = np.full(flat.shape, np.nan)
    with np.errstate(all="ignore"):
        simple = defined & (np.linalg.cond(vectors) < WORST_EIGENVECTORS)
    if simple.any():
        v, w = vectors[simple], values[simple].astype(complex)
        logs[simple] = ((v * np.log(w)[:, None, :]) @ np.linalg.inv(v)).real
    for k in np.flatnonzero(defined & ~simple):
        # Nearly defective (for instance a retarder and an equally strong diattenuator crossed at 45 degrees).
        logs[k] = _careful_logarithm(flat[k])
    logarithm = logs.reshape(m.shape)
    turned = G @ np.swapaxes(logarithm, -1, -2) @ G
    throughput = logarithm[..., 0, 0, None, None] * np.eye(4)
    mean = (logarithm - turned) / 2 + throughput
    return Differential(mean, (logarithm + turned) / 2 - throughput, defined.reshape(m.shape[:-2]))


def differential_slopes(m: RealArray, defined: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Gradients (9, ..., 16) of the parts of Lm and Lu by the elements of m.

    Order: retardance vector, diattenuation vector, depolarization exponents. With m = V diag(w) V^-1 the derivative of
    the logarithm is d ln m = V (F * (V^-1 dm V)) V^-1, F holding the divided differences of ln w (Higham, Functions of
    Matrices, Theorem 3.11). NaN where not defined, and where V is too ill-conditioned to use.
    """
    flat = np.where(defined[..., None, None], m, np.diag([1.0, 0.5, 0.4, 0.3])).reshape(-1, 4, 4)
    values, vectors = np.linalg.eig(flat)
    w, v = values.astype(complex), vectors.astype(complex)
    with np.errstate(all="ignore"):
        inverse = np.linalg.inv(np.where((np.linalg.cond(v) < WORST_EIGENVECTORS)[:, None, None], v, np.nan))
        difference = w[:, :, None] - w[:, None, :]
        close = np.abs(difference) < 1e-7 * np.abs(w).max(axis=-1)[:, None, None]
        quotient = (np.log(w)[:, :, None] - np.log(w)[:, None, :]) / np.where(close, 1, difference)
    quotient = np.where(close, 2 / (w[:, :, None] + w[:, None, :]), quotient)
    out = np.empty((9, len(flat), 16))
    for k, weight in enumerate(_WEIGHTS):
        # <weight, dL> = <V^-T (F * (V^-1 weight^T V)^T) V^T, dm>
        inner = quotient * np.swapaxes(inverse @ weight.T @ v, -1, -2)
        out[k] = (np.swapaxes(inverse, -1, -2) @ inner @ np.swapaxes(v, -1, -2)).real.reshape(-1, 16)
    out[:, ~defined.reshape(-1)] = np.nan
    return out.reshape(9, *m.shape[:-2], 16)


def _weights() -> NDArray[np.float64]:
    """Weights (9, 4, 4) whose inner products with L give the nine parts."""
    out = np.zeros((9, 4, 4))
    for k, (i, j) in enumerate([(2, 3), (3, 1), (1, 2)]):
        out[k, i, j], out[k, j, i] = 0.5, -0.5
        out[3 + k, 0, k + 1] = out[3 + k, k + 1, 0] = 0.5
        out[6 + k, 0, 0], out[6 + k, k + 1, k + 1] = 1.0, -1.0
    return out


_WEIGHTS = _weights()


def _careful_logarithm(m: RealArray) -> RealArray:
    """Real logarithm by scipy's inverse scaling and squaring; slower, but it needs no eigenvectors."""
    from scipy.linalg import logm

    with warnings.catch_warnings():
        # It warns when its error estimate passes 2e-13.
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.real(logm(m)))
