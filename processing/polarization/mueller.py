"""Mueller matrices of ideal elements, and the algebra between Jones, Mueller and coherency matrices.

Convention (docs/conventions.md): decreasing phase, angles counter-clockwise from +x as seen looking
into the beam, Pauli order s0 = 1, s1 = diag(1, -1), s2 = [[0, 1], [1, 0]], s3 = [[0, i], [-i, 0]].
Angles are in radians here; every function broadcasts over leading axes and returns (..., 4, 4).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from processing.arrays import Array, ComplexArray

IDEAL_DEPOLARIZER: NDArray[np.float64] = np.diag([1.0, 0.0, 0.0, 0.0])
IDEAL_MIRROR: NDArray[np.float64] = np.diag([1.0, 1.0, -1.0, -1.0])

PAULI: NDArray[np.complex128] = np.array(
    [[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1j], [-1j, 0]]], dtype=complex
)

# vec(J) (x) vec(J)^* = TO_COHERENCY . vec(M): built once from M_ab = 1/2 tr(s_a J s_b J^H).
_TO_MUELLER = 0.5 * np.einsum("aji,bkl->abikjl", PAULI, PAULI).reshape(16, 16)
_TO_COHERENCY = np.linalg.inv(_TO_MUELLER)


def rotation(angle: ArrayLike) -> Array:
    """Mueller rotation R such that an element turned by `angle` is R(angle) M R(-angle)."""
    t = 2 * np.asarray(angle, dtype=float)
    c, s = np.cos(t), np.sin(t)
    out = np.zeros((*t.shape, 4, 4))
    out[..., 0, 0] = out[..., 3, 3] = 1.0
    out[..., 1, 1] = out[..., 2, 2] = c
    out[..., 1, 2], out[..., 2, 1] = -s, s
    return out


def retarder(azimuth: ArrayLike, retardance: ArrayLike, lost: ArrayLike = 0.0) -> Array:
    """Linear retarder with its fast axis at `azimuth` (docs/conventions.md, "Mueller calculus").

    `lost` : share of what the retardance acts on that is lost to the average over several retardances.
    """
    t = 2 * np.asarray(azimuth, dtype=float)
    d, kept = np.asarray(retardance, dtype=float), 1 - np.asarray(lost, dtype=float)
    c, s, cd, sd = np.cos(t), np.sin(t), kept * np.cos(d), kept * np.sin(d)
    out = np.zeros((*np.broadcast_shapes(t.shape, cd.shape), 4, 4))
    out[..., 0, 0] = 1.0
    out[..., 1, 1], out[..., 2, 2], out[..., 3, 3] = c * c + s * s * cd, s * s + c * c * cd, cd
    out[..., 1, 2] = out[..., 2, 1] = c * s * (1 - cd)
    out[..., 1, 3], out[..., 3, 1] = -s * sd, s * sd
    out[..., 2, 3], out[..., 3, 2] = c * sd, -c * sd
    return out


def diattenuator(azimuth: ArrayLike, t_max: ArrayLike, t_min: ArrayLike) -> Array:
    """Linear diattenuator that transmits `t_max` along `azimuth` and `t_min` across it (intensities)."""
    t = 2 * np.asarray(azimuth, dtype=float)
    hi, lo = np.asarray(t_max, dtype=float), np.asarray(t_min, dtype=float)
    c, s = np.cos(t), np.sin(t)
    a, b, g = (hi + lo) / 2, (hi - lo) / 2, np.sqrt(np.maximum(hi * lo, 0.0))
    out = np.zeros((*np.broadcast_shapes(t.shape, a.shape), 4, 4))
    out[..., 0, 0], out[..., 3, 3] = a, g
    out[..., 0, 1] = out[..., 1, 0] = b * c
    out[..., 0, 2] = out[..., 2, 0] = b * s
    out[..., 1, 1], out[..., 2, 2] = a * c * c + g * s * s, a * s * s + g * c * c
    out[..., 1, 2] = out[..., 2, 1] = (a - g) * c * s
    return out


def polarizer(azimuth: ArrayLike, extinction: ArrayLike = 0.0, ellipticity: ArrayLike = 0.0) -> Array:
    """Polarizer with its transmission axis at `azimuth`; it carries its factor 1/2.

    `extinction` is the intensity leak T_min / T_max (0 = ideal). It transmits the state of `ellipticity` in radians,
    positive for right-handed: 0 linear, pi/4 circular.
    """
    if not np.any(ellipticity):
        return diattenuator(azimuth, 1.0, extinction)
    t, e, leak = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (azimuth, ellipticity, extinction)))
    a, b, g = (1 + leak) / 2, (1 - leak) / 2, np.sqrt(np.maximum(leak, 0.0))
    d = np.stack([np.cos(2 * e) * np.cos(2 * t), np.cos(2 * e) * np.sin(2 * t), np.sin(2 * e)], axis=-1)
    out = np.empty((*d.shape[:-1], 4, 4))
    out[..., 0, 0], out[..., 0, 1:], out[..., 1:, 0] = a, b[..., None] * d, b[..., None] * d
    out[..., 1:, 1:] = g[..., None, None] * np.eye(3) + (a - g)[..., None, None] * d[..., None] * d[..., None, :]
    return out


def from_jones(jones: ArrayLike) -> Array:
    """Mueller-Jones matrix of Jones matrices (..., 2, 2): M_ab = 1/2 tr(s_a J s_b J^H)."""
    j = np.asarray(jones, dtype=complex)
    return coherency_to_mueller(_outer_vec(j))


def _outer_vec(jones: ComplexArray) -> ComplexArray:
    v = jones.reshape(*jones.shape[:-2], 4)
    return v[..., :, None] * v[..., None, :].conj()


def coherency(mueller: ArrayLike) -> ComplexArray:
    """Coherency matrix vec(J) vec(J)^H summed over the ensemble, of Mueller matrices (..., 4, 4).

    Hermitian with trace 2 m00; not normalized. vec is row-major: (J00, J01, J10, J11).
    """
    m = np.asarray(mueller)
    h = m.reshape(*m.shape[:-2], 16) @ _TO_COHERENCY.T
    return h.reshape(*m.shape[:-2], 4, 4)


def coherency_to_mueller(h: ArrayLike) -> Array:
    """Mueller matrices (..., 4, 4) of coherency matrices (..., 4, 4); the inverse of `coherency`."""
    h = np.asarray(h, dtype=complex)
    m = h.reshape(*h.shape[:-2], 16) @ _TO_MUELLER.T
    return np.asarray(m.real.reshape(*h.shape[:-2], 4, 4))
