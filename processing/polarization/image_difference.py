"""How far two polarization images differ: orientation, magnitude, xi0 (Jarecki and Kupinski, Secs. V-A, V-B)."""

import numpy as np
from numpy.typing import ArrayLike

from processing.arrays import Array


def linear_diattenuation(m: ArrayLike) -> Array:
    """(D1, D2) = (m01, m02)/m00 of Mueller matrices (..., 4, 4): shape (..., 2)."""
    a = np.asarray(m, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(a[..., 0, 1:3] / a[..., 0, 0, None])


def orientation_difference(d_a: ArrayLike, d_b: ArrayLike) -> Array:
    """psi_a - psi_b, radians in -pi/2..pi/2, of linear diattenuations (..., 2).

    Half the wrapped difference of the doubled angles: an arc cosine, as Jarecki and Kupinski have it, loses half its
    digits near zero, and needs the linear magnitude to be divided by.
    """
    a, b = np.asarray(d_a, dtype=float), np.asarray(d_b, dtype=float)
    sine = a[..., 1] * b[..., 0] - a[..., 0] * b[..., 1]
    cosine = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
    return np.asarray(0.5 * np.arctan2(sine, cosine))


def magnitude(d: ArrayLike) -> Array:
    """|D|, the linear diattenuation, of (..., 2)."""
    v = np.asarray(d, dtype=float)
    return np.asarray(np.hypot(v[..., 0], v[..., 1]))


def rmsd(difference: ArrayLike) -> float:
    """Root mean square of the finite values; NaN without any."""
    v = np.asarray(difference, dtype=float)
    v = v[np.isfinite(v)]
    return float(np.sqrt(np.mean(v**2))) if v.size else float("nan")
