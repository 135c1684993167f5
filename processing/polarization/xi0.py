"""xi0 and M00 from intensities and a known dominant process: the two-coefficient estimate.

With Phi = W [m0 mID], P = Phi alpha is linear in alpha = (alpha_0, alpha_ID), and xi0 = (alpha_0 +
alpha_ID/4)/(alpha_0 + alpha_ID), M00 = alpha_0 + alpha_ID, which has none of the singularities of the ratio form of
Jarecki and Kupinski (Sec. IV; docs/conventions.md). Nothing is clipped: a value outside [1/4, 1] speaks against the
model m0 and is flagged. Standard errors hold the noise of the intensities, not errors of m0.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from processing.arrays import Array, BoolArray
from processing.computing.compiling import compiled, in_parts
from processing.computing.threads import for_ranges
from processing.errors import ProcessError
from processing.polarization.mueller import coherency

#: Rounding that a Mueller-Jones matrix may have (float32), and matrices that are looked at closely.
TOLERANCE, LOOKED_AT = 1e-4, 2000


@dataclass(frozen=True)
class Xi0Estimate:
    """Estimate of each pixel, arrays of the shape of an image.

    Attributes
    ----------
    xi0, m00 : the estimates; M00 in the units of the intensities.
    xi0_stderr, m00_stderr : their standard errors (first order). With no variance given they come
        from the residual of the fit and are NaN if nothing is left over (K < 3).
    condition : condition number of Phi; large where the modelled light has no polarization to modulate.
    valid : finite, positive M00, condition and noise (standard error, were xi0 1/4) within the limits asked for.
    unphysical : valid, but outside [1/4, 1] by more than its standard error.
    chi_square : weighted sum of squared residuals over K - 2; NaN for an unweighted fit.
    alpha_0_stderr : standard error of alpha_0 = M00 (4 xi0 - 1)/3, the weight of m0 in the matrix.
    correlation : between the errors of alpha_0 and M00.
    """

    xi0: Array
    xi0_stderr: Array
    m00: Array
    m00_stderr: Array
    condition: Array
    valid: BoolArray
    unphysical: BoolArray
    chi_square: Array
    alpha_0_stderr: Array
    correlation: Array


def estimate(
    intensities: ArrayLike,
    variance: ArrayLike | None,
    w: ArrayLike,
    m0: ArrayLike,
    *,
    shared: tuple[Array, Array] | None = None,
    weighted: bool = False,
    max_condition: float = 100.0,
    max_stderr: float = 0.1,
) -> Xi0Estimate:
    """Least-squares xi0 and M00 of every pixel.

    Parameters
    ----------
    intensities : (K, ...), dark-subtracted; K measurements of each pixel.
    variance : (K, ...) or None, of the intensities (shot and read noise), same unit squared.
    w : (K, 16), measurement matrix, rows kron(a, g). For a mosaic under one generator state, its 4 channels.
    m0 : (..., 4, 4), dominant Mueller-Jones matrix with element 00 equal to 1; NaN outside the object.
    shared : (K, D), what each of D independent errors that all share adds to the intensities, and (...) the standard
        error of each pixel in that unit.
    weighted : weigh by 1/variance; else equal weights as in Jarecki and Kupinski, with the variance propagated.
    max_condition, max_stderr : limits of the validity mask, the second on the error that xi0 would have at 1/4.

    Raises
    ------
    ProcessError : m0 is no Mueller-Jones matrix; xi0 would then not be what it is called.
    """
    p = np.asarray(intensities)
    rows = np.asarray(w, dtype=float).reshape(-1, 16)
    model = np.asarray(m0).reshape(*p.shape[1:], 16)
    if rows.shape[0] != p.shape[0]:
        raise ValueError(f"W has {rows.shape[0]} rows and there are {p.shape[0]} intensities a pixel")
    v = None if variance is None else np.asarray(variance)
    if v is not None and v.shape != p.shape:
        raise ValueError(f"variance has shape {v.shape}, the intensities {p.shape}")
    if weighted and v is None:
        raise ValueError("weights need a variance")

    require_mueller_jones(model)
    common, unit = shared or (np.zeros((len(rows), 0)), np.ones(()))
    sums = _Sums(p.shape[1:], common.shape[1])
    for k, row in enumerate(rows):
        vk = None if v is None else np.asarray(v[k], dtype=float)
        sums.add(np.asarray(p[k], dtype=float), model @ row, row[0], vk, common[k], weighted=weighted)
    sums.c *= unit
    return sums.solve(len(rows), max_condition, max_stderr)


def require_mueller_jones(m0: Array) -> None:
    """Raise ProcessError unless matrices (..., 16) have element 00 equal to 1 and a coherency matrix of rank one.

    The sum of squares, 4 for every Mueller-Jones matrix, is looked at everywhere; H^2 = H, which also finds unphysical
    matrices of that size, in up to `LOOKED_AT` of them. NaN passes.
    """
    flat = m0.reshape(-1, 16)
    size = np.einsum("pi,pi->p", flat, flat)
    some = flat[:: max(1, len(flat) // LOOKED_AT)]
    h = coherency(some[np.isfinite(some).all(axis=1)].reshape(-1, 4, 4)) / 2
    off = (np.abs(size - 4) > TOLERANCE).sum() + (np.abs(h @ h - h).max(axis=(1, 2)) > TOLERANCE).sum()
    if off:
        raise ProcessError(
            f"the dominant process is no Mueller-Jones matrix in {off} pixels: it must have m00 = 1 and no "
            "depolarization of its own. Correct the reflectance model."
        )


class _Sums:
    """Normal equations of one fit a pixel, accumulated over the measurements."""

    def __init__(self, shape: tuple[int, ...], common: int) -> None:
        zero = np.zeros(shape)
        # Phi^T V Phi (s), unweighted gram (g), Phi^T C Phi of the sandwich (t), Phi^T V P (b).
        self.s, self.g, self.t = ([zero.copy() for _ in range(3)] for _ in range(3))
        self.b = [zero.copy() for _ in range(2)]
        # Phi^T V times what the measurements share.
        self.c = np.zeros((2, common, *shape))
        self.square = zero.copy()
        self.scaled = False
        self.have_variance = False

    def add(self, p: Array, p0: Array, pid: float, v: Array | None, common: Array, *, weighted: bool) -> None:
        self.have_variance = v is not None
        weight = 1.0 / v if weighted and v is not None else np.ones(())
        spread = weight * weight * v if v is not None else weight
        for i, product in enumerate((p0 * p0, p0 * pid, np.full_like(p0, pid * pid))):
            self.g[i] += product
            self.s[i] += weight * product
            self.t[i] += spread * product
        self.b[0] += weight * p0 * p
        self.b[1] += weight * pid * p
        for d, error in enumerate(common):
            self.c[0, d] += weight * p0 * error
            self.c[1, d] += weight * pid * error
        self.square += weight * p * p
        self.scaled = weighted

    def solve(self, count: int, max_condition: float, max_stderr: float) -> Xi0Estimate:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            a, c, d = self.s
            det = a * d - c * c
            inverse = (d / det, -c / det, a / det)
            alpha_0 = inverse[0] * self.b[0] + inverse[1] * self.b[1]
            alpha_id = inverse[1] * self.b[0] + inverse[2] * self.b[1]
            residual = np.maximum(self.square - alpha_0 * self.b[0] - alpha_id * self.b[1], 0.0)
            free = max(count - 2, 0)
            reduced = residual / free if free else np.full_like(a, np.nan)
            first, second = self.c
            shared = [(a * b).sum(axis=0) for a, b in ((first, first), (first, second), (second, second))]
            spread = [t + c for t, c in zip(self.t, shared, strict=True)]
            cov = _sandwich(inverse, spread)
            if not self.have_variance:
                cov = (cov[0] * reduced, cov[1] * reduced, cov[2] * reduced)
            total = alpha_0 + alpha_id
            xi0 = (alpha_0 + alpha_id / 4) / total
            # Derivatives of xi0 by alpha_0 and alpha_ID.
            u, v = 0.75 * alpha_id / total**2, -0.75 * alpha_0 / total**2
            xi0_stderr = np.sqrt(u * u * cov[0] + 2 * u * v * cov[1] + v * v * cov[2])
            m00_stderr = np.sqrt(cov[0] + 2 * cov[1] + cov[2])
            condition = _condition(self.g)
            # The error that xi0 would have at 1/4: a limit on its own error would select by outcome.
            noise = 0.75 * np.sqrt(cov[0]) / total
            # With no degree of freedom there is no residual to judge by: the condition alone decides.
            precise = (noise <= max_stderr) | (not self.have_variance and free == 0)
            valid = np.isfinite(xi0) & (total > 0) & (condition <= max_condition) & precise
            slack = np.nan_to_num(xi0_stderr)
            unphysical = valid & ((xi0 < 0.25 - slack) | (xi0 > 1 + slack))
        chi_square = reduced if self.scaled else np.full_like(a, np.nan)
        alpha_0_stderr = np.sqrt(cov[0])
        with np.errstate(divide="ignore", invalid="ignore"):
            correlation = (cov[0] + cov[1]) / (alpha_0_stderr * m00_stderr)
        return Xi0Estimate(
            xi0, xi0_stderr, total, m00_stderr, condition, valid, unphysical, chi_square, alpha_0_stderr, correlation
        )


def _sandwich(inverse: tuple[Array, Array, Array], t: list[Array]) -> tuple[Array, Array, Array]:
    # (G^-1) T (G^-1) of symmetric 2 x 2 matrices, as (00, 01, 11).
    i, j, k = inverse
    x, y, z = t
    return (
        i * i * x + 2 * i * j * y + j * j * z,
        i * j * x + (i * k + j * j) * y + j * k * z,
        j * j * x + 2 * j * k * y + k * k * z,
    )


def _condition(gram: list[Array]) -> Array:
    # Singular values of Phi are square roots of the gram matrix's eigenvalues.
    a, c, d = gram
    half, gap = (a + d) / 2, np.sqrt(((a - d) / 2) ** 2 + c * c)
    return np.asarray(np.sqrt((half + gap) / np.maximum((a * d - c * c) / (half + gap), 0.0)))


def xi0_and_m00(
    intensities: NDArray[np.float32] | NDArray[np.uint16],
    p0: NDArray[np.float32],
    p_id: ArrayLike,
    out: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Fast path for four intensities a pixel: the same unweighted estimate, closed form, no errors.

    Parameters
    ----------
    intensities : (4, ...), float32 or uint16.
    p0 : (4, ...), W m0, float32.
    p_id : (4,), W mID, the first column of W.
    out : two contiguous arrays (...) to fill again; the first touch of new memory costs as much as the sums.

    Returns
    -------
    xi0, m00 : (...), float32; NaN where the modelled light carries no modulation.
    """
    if len(intensities) != 4 or p0.shape != intensities.shape:
        raise ValueError(f"four intensities and four model values a pixel; got {intensities.shape} and {p0.shape}")
    shape = intensities.shape[1:]
    xi0, m00 = out if out is not None else (np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32))
    i4 = np.ascontiguousarray(intensities).reshape(4, -1)
    q4 = np.ascontiguousarray(p0).reshape(4, -1)
    first, flat_xi0, flat_m00 = np.asarray(p_id, dtype=np.float32), xi0.reshape(-1), m00.reshape(-1)
    for_ranges(flat_xi0.size, lambda start, stop: _four(i4, q4, first, flat_xi0, flat_m00, start, stop))
    return xi0, m00


@in_parts
def _four_at_once(i4: Array, q4: Array, pid: Array, xi0: Array, m00: Array, part: slice) -> None:
    unit = pid / np.sqrt(pid @ pid)
    p, q, length = i4[:, part].astype(np.float32), q4[:, part], np.sqrt(pid @ pid)
    share, level = unit @ q, unit @ p
    across = q - share * unit[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        alpha_0 = (across * (p - level * unit[:, None])).sum(axis=0) / np.square(across).sum(axis=0)
        alpha_id = (level - alpha_0 * share) / length
        m00[part] = alpha_0 + alpha_id
        xi0[part] = (alpha_0 + alpha_id / 4) / m00[part]


@compiled(_four_at_once, fastmath={"contract", "reassoc", "arcp", "nsz"}, error_model="numpy")
def _four(i4, q4, pid, xi0, m00, start, stop):  # type: ignore[no-untyped-def]
    # Slices, a loop from 0 and division without exceptions: only then are eight pixels taken at a time.
    one = np.float32(1.0)
    c0, c1, c2, c3 = pid[0], pid[1], pid[2], pid[3]
    inv = one / (c0 * c0 + c1 * c1 + c2 * c2 + c3 * c3)
    p0, p1, p2, p3 = i4[0, start:stop], i4[1, start:stop], i4[2, start:stop], i4[3, start:stop]
    q0, q1, q2, q3 = q4[0, start:stop], q4[1, start:stop], q4[2, start:stop], q4[3, start:stop]
    out_xi0, out_m00 = xi0[start:stop], m00[start:stop]
    for n in range(out_xi0.size):
        a0, a1, a2, a3 = q0[n], q1[n], q2[n], q3[n]
        b0, b1, b2, b3 = np.float32(p0[n]), np.float32(p1[n]), np.float32(p2[n]), np.float32(p3[n])
        # Split p0 along p_id and across it: the difference keeps its digits where a determinant would not.
        share = (a0 * c0 + a1 * c1 + a2 * c2 + a3 * c3) * inv
        level = (b0 * c0 + b1 * c1 + b2 * c2 + b3 * c3) * inv
        d0, d1, d2, d3 = a0 - share * c0, a1 - share * c1, a2 - share * c2, a3 - share * c3
        signal = d0 * (b0 - level * c0) + d1 * (b1 - level * c1) + d2 * (b2 - level * c2) + d3 * (b3 - level * c3)
        alpha_0 = signal / (d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3)
        alpha_id = level - alpha_0 * share
        total = alpha_0 + alpha_id
        out_m00[n] = total
        out_xi0[n] = (alpha_0 + np.float32(0.25) * alpha_id) / total
