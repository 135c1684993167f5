"""Material constants n + i k, a, b of the polarized diffuse model from Mueller elements or Stokes vectors.

Those of a sum of two processes are in `plastic_fit`.

Two methods (paper, conclusion). Of whole Mueller matrices, weighted least squares on the dominant process: the
distance of M/m00 from m0 depends on m0 by <M, m0> alone, for all Mueller-Jones matrices are of one length. That is
linear in M, so noise does not bias it, and largest at the dominant process, however the small eigenvalues differ.

Of fewer numbers, linear correlation: P = alpha_0 W m0 + alpha_ID W mID at each pixel, the two coefficients projected
out, with alpha_0 >= 0. It needs triple degeneracy: small eigenvalues that differ look like another m0. Their usual
spread, or what the residual shows of it, is in the errors.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from processing.arrays import Array, ComplexArray
from processing.geometry.frames import ScatteringGeometry
from processing.polarization.mueller import coherency, coherency_to_mueller
from processing.reflectance import fresnel, polarized_diffuse
from processing.reflectance.base import normalized_mueller
from processing.reflectance.fitted_constants import (
    DEPARTURE,
    MaterialFit,
    Ranges,
    evenly,
    result_of,
    search,
    unexplained_square,
)

DIFFUSE = Ranges(
    kind="polarized_diffuse",
    names=("n", "k", "a", "b"),
    lower=np.array([1.01, 0.0, 0.0, 0.3]),
    upper=np.array([4.0, 4.0, 3.0, 8.0]),
    starts=((1.3, 0.1, 0.1, 2.0), (1.6, 0.02, 0.3, 1.5), (1.2, 0.4, 0.05, 3.0), (2.0, 1.0, 0.5, 2.0)),
    sizes=(0.1, 0.1, 0.1, 1.0),
    small=(0.0, 0.02, 0.0, 0.0),
)
#: Steps of derivatives.
STEPS = np.array([1e-4, 1e-4, 1e-4, 1e-3])
_PAULI = np.array([[[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, -1j], [1j, 0]]])


def fit_values(
    geometry: ScatteringGeometry,
    values: ArrayLike,
    rows: ArrayLike,
    covariance: ArrayLike,
    *,
    max_pixels: int = 5000,
    correlation: bool = False,
    moved: Sequence[tuple[ArrayLike, ArrayLike]] = (),
) -> MaterialFit:
    """Constants from values that are linear in M, with correlated noise: Mueller elements or Stokes vectors.

    Parameters
    ----------
    values : (K, N), of each pixel.
    rows : (K, 16), from the Mueller matrix to the values.
    covariance : (N, K, K) of the values. Where it is made from the noisy values themselves, the weights follow the
        noise; the level of the light alone is enough.
    max_pixels : use at most so many, evenly spread.
    correlation : by linear correlation, also where all elements are given.
    moved : values and rows of the same pixels with one standard uncertainty of each uncertain input of the instrument.

    Raises
    ------
    NotDetermined : fewer than 10 pixels are finite.
    """
    x, c, r = (np.asarray(a, dtype=float) for a in (values, covariance, rows))
    keep = evenly(np.isfinite(x).all(axis=0) & np.isfinite(c).all(axis=(1, 2)), max_pixels)
    # The ridge is for values without noise.
    c = c[keep] + 1e-9 * np.trace(c[keep], axis1=1, axis2=2)[:, None, None] * np.eye(len(x))
    model = _Forward(geometry[keep])
    pairs = [(np.asarray(v, dtype=float)[:, keep], np.asarray(w, dtype=float)) for v, w in moved]
    if not correlation and np.linalg.matrix_rank(r) == 16:
        back = np.linalg.pinv(r)
        each = [(np.linalg.pinv(w) @ v).T for v, w in pairs]
        return _fit_dominant(model, (back @ x[:, keep]).T, back @ c @ back.T, each)
    whiten = np.linalg.inv(np.linalg.cholesky(c))
    reference, *variants = (_Correlation.of(model, v, w, whiten) for v, w in [(x[:, keep], r), *pairs])
    return _fit_correlation(reference, variants)


def _fit_dominant(model: "_Forward", data: Array, covariance: Array, moved: Sequence[Array]) -> MaterialFit:
    """Fit Mueller matrices (N, 16), whose noise has the covariance (N, 16, 16); `moved` are the same by an instrument
    that is off.
    """
    from scipy.optimize import minimize

    level = np.maximum(data[:, 0], 0.0)
    # M/m00 weighs as m00^2 over its variance; <M, m0> has one m00 of it.
    weight = level / np.trace(covariance, axis1=1, axis2=2)
    weight = (weight / np.sum(weight * level))[:, None]
    scaled = data * weight

    def unlike(q: Array) -> float:
        return -float(np.sum(scaled * model.mueller(q).reshape(-1, 16)))

    bounds = list(zip(DIFFUSE.lower.tolist(), DIFFUSE.upper.tolist(), strict=True))
    fits = [minimize(unlike, np.array(s), method="L-BFGS-B", bounds=bounds, tol=1e-13) for s in DIFFUSE.starts]
    # The search ends where its sum stops changing; the root of its slope is sharper.
    constants = _root(model, np.asarray(min(fits, key=lambda fit: float(fit.fun)).x), scaled)
    off = np.array([_root(model, constants, values * weight) - constants for values in moved]).reshape(-1, 4)
    scores, curvature = _slopes(model, constants, scaled)
    parts = _neighbours(model.mueller(constants).reshape(-1, 16))
    noise = np.einsum("nki,nij,nlj->nkl", parts, covariance, parts, optimize=True)
    whiten = np.linalg.inv(np.linalg.cholesky(noise)) @ parts
    residual, *changes = (np.einsum("nki,ni->nk", whiten, values) for values in (data, *moved))
    square = unexplained_square(residual, [change - residual for change in changes])
    free = 6 * len(data) - 4
    return result_of(
        constants, -curvature.sum(axis=0), scores, square, free=free, method="dominant process", off=off, of=DIFFUSE
    )


def _root(model: "_Forward", start: Array, scaled: Array) -> Array:
    """Constants near to `start` at which the slope of sum(scaled * m0) is zero."""
    constants = start.copy()
    for _ in range(2):
        slope, curvature = (np.sum(part, axis=0) for part in _slopes(model, constants, scaled))
        inside = DIFFUSE.inside(constants)
        if inside.any():
            step = np.linalg.lstsq(curvature[np.ix_(inside, inside)], slope[inside], rcond=1e-10)[0]
            constants[inside] = np.clip(constants[inside] - step, DIFFUSE.lower[inside], DIFFUSE.upper[inside])
    return constants


def _slopes(model: "_Forward", q: Array, scaled: Array) -> tuple[Array, Array]:
    """First (N, 4) and second (N, 4, 4) derivatives of sum(scaled * m0) by the constants, pixel by pixel."""

    def overlap(*steps: tuple[int, float]) -> Array:
        moved = q.copy()
        for k, sign in steps:
            moved[k] += sign * STEPS[k]
        return np.asarray(np.sum(scaled * model.mueller(moved).reshape(-1, 16), axis=1))

    still = overlap()
    first, second = np.empty((len(scaled), 4)), np.empty((len(scaled), 4, 4))
    for i in range(4):
        up, down = overlap((i, 1)), overlap((i, -1))
        first[:, i] = (up - down) / (2 * STEPS[i])
        second[:, i, i] = (up - 2 * still + down) / STEPS[i] ** 2
        for j in range(i):
            mixed = overlap((i, 1), (j, 1)) - overlap((i, 1), (j, -1)) - overlap((i, -1), (j, 1))
            mixed = mixed + overlap((i, -1), (j, -1))
            second[:, i, j] = second[:, j, i] = mixed / (4 * STEPS[i] * STEPS[j])
    return first, second


def _vectors(m0: Array) -> ComplexArray:
    """Orthonormal vectors (N, 4, 4) of Jones matrices, that of m0 (N, 16) first, all smooth over the pixels."""
    vectors = [np.linalg.eigh(coherency(m0.reshape(-1, 4, 4)))[1][..., -1]]
    jones = vectors[0].reshape(-1, 2, 2)
    for pauli in _PAULI:
        vector = (jones @ pauli).reshape(-1, 4)
        for previous in vectors:
            vector = vector - previous * np.sum(previous.conj() * vector, axis=1, keepdims=True)
        vectors.append(vector / np.linalg.norm(vector, axis=1, keepdims=True))
    return np.stack(vectors, axis=1)


def _mix(first: ComplexArray, second: ComplexArray) -> Array:
    """Matrix (N, 16) of the coherency |first><second| + |second><first|."""
    h = first[:, :, None] * second[:, None, :].conj()
    return coherency_to_mueller(h + np.swapaxes(h.conj(), 1, 2)).reshape(-1, 16)


def _neighbours(m0: Array) -> Array:
    """Directions (N, 6, 16) in which a matrix has another dominant process than m0 (N, 16)."""
    v = _vectors(m0)
    return np.stack([_mix(v[:, 0], turn * v[:, k]) for k in (1, 2, 3) for turn in (1, 1j)], axis=1)


def _departures(m0: Array) -> Array:
    """Changes (8, N, 16) of M/m00 by small eigenvalues that differ, one standard deviation each."""
    v = _vectors(m0)
    diagonal = [_mix(v[:, k], v[:, k]) for k in (1, 2, 3)]
    parts = [(diagonal[0] - diagonal[1]) / 2, (diagonal[0] + diagonal[1] - 2 * diagonal[2]) / np.sqrt(12)]
    parts += [_mix(v[:, i], turn * v[:, j]) / np.sqrt(2) for i, j in ((1, 2), (1, 3), (2, 3)) for turn in (1, 1j)]
    # Hermitian matrices of unit norm, over sqrt(2); with 8 of them the three eigenvalues have this deviation.
    return np.asarray(DEPARTURE * np.sqrt(3 / 8) * np.sqrt(2) * np.stack(parts))


@dataclass(frozen=True)
class _Correlation:
    """Data (N, K) in units of the noise and rows (N, K, 16) that lead from the Mueller matrix to them.

    What the ideal depolarizer explains is projected out of the data and of the model.
    """

    model: "_Forward"
    rows: Array
    flat: Array
    light: Array
    data: Array

    @classmethod
    def of(cls, model: "_Forward", values: Array, rows: Array, whiten: Array) -> "_Correlation":
        rows, data = whiten @ rows, np.einsum("nij,jn->ni", whiten, values)
        size = np.linalg.norm(rows[:, :, 0], axis=1, keepdims=True)
        flat = rows[:, :, 0] / size
        light = np.sum(flat * data, axis=1) / size[:, 0]
        return cls(model, rows, flat, light, data - flat * np.sum(flat * data, axis=1, keepdims=True))

    def polarized(self, values: Array) -> Array:
        return np.asarray(values - self.flat * np.sum(self.flat * values, axis=1, keepdims=True))

    def parts(self, q: Array) -> tuple[Array, Array]:
        modelled = self.polarized(np.einsum("nki,ni->nk", self.rows, self.model.mueller(q).reshape(-1, 16)))
        return modelled, np.sum(modelled * self.data, axis=1, keepdims=True)

    def residual(self, q: Array) -> Array:
        modelled, overlap = self.parts(q)
        size = np.maximum(np.sum(modelled**2, axis=1, keepdims=True), 1e-300)
        return np.asarray(self.data - modelled * np.maximum(overlap, 0) / size)


def _fit_correlation(reference: _Correlation, moved: Sequence[_Correlation]) -> MaterialFit:
    """Fit by linear correlation; `moved` are the same data by an instrument that is off."""
    constants, jacobian = search(reference.residual, DIFFUSE)
    off = np.array([search(variant.residual, DIFFUSE, constants)[0] - constants for variant in moved]).reshape(-1, 4)
    residual = reference.residual(constants)
    changes = [variant.residual(constants) - residual for variant in moved]
    modelled, overlap = reference.parts(constants)
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = overlap[:, 0] / (np.linalg.norm(modelled, axis=1) * np.linalg.norm(reference.data, axis=1))
    slopes = jacobian.reshape(*residual.shape, 4)
    unit = modelled / np.maximum(np.linalg.norm(modelled, axis=1, keepdims=True), 1e-300)
    departures, unlike = [], 0.0
    for change in _departures(reference.model.mueller(constants).reshape(-1, 16)):
        extra = reference.polarized(reference.light[:, None] * np.einsum("nki,ni->nk", reference.rows, change))
        extra -= unit * np.sum(unit * extra, axis=1, keepdims=True)
        departures.append(reference.model.fields @ np.einsum("nkp,nk->np", slopes, extra))
        unlike += float(np.sum(extra**2))
    square, free = unexplained_square(residual, changes), residual.size - 2 * len(residual) - 4
    # Eigenvalues may differ by more than usual: by as much as makes the residual.
    more = max(1.0, float(np.sqrt(max(square - free, 0) / unlike)))
    scores, curvature = np.einsum("nkp,nk->np", slopes, residual), jacobian.T @ jacobian
    method, apart = "linear correlation", more * np.concatenate(departures)
    result = result_of(
        constants, curvature, scores, square, free=free, method=method, off=off, departures=apart, of=DIFFUSE
    )
    share = float(np.sqrt(np.sum(residual**2) / np.sum(reference.data**2)))
    return replace(result, residual=share, correlation=float(np.nanmean(rho)))


class _Forward:
    """m0 of given directions as a function of (n, k, a, b), everything else worked out once."""

    def __init__(self, geometry: ScatteringGeometry) -> None:
        self.via_s, self.via_p = fresnel.basis(geometry)
        self.theta_d, self.sine = geometry.angles.theta_d, np.sin(geometry.angles.theta_h)
        self.diffuse = polarized_diffuse.diffuse_jones(geometry)
        #: Fields (10, N) over the surface, whose squares add up to 1: a random field with weights of unit variance.
        # Small eigenvalues that were the same over the whole surface would hardly look like other constants.
        x, y, z = np.moveaxis(geometry.normal, -1, 0)
        second = np.array([x * x, y * y, z * z, *(np.sqrt(2) * p for p in (x * y, y * z, z * x))])
        self.fields = np.concatenate([[np.ones_like(x), x, y, z], second]) / np.sqrt(3)

    def mueller(self, p: Array) -> Array:
        n, k, a, b = p
        rs, rp = fresnel.amplitudes(complex(n, k), self.theta_d)
        jones: ComplexArray = rs[:, None, None] * self.via_s + rp[:, None, None] * self.via_p
        return normalized_mueller(jones + (a * self.sine**b)[:, None, None] * self.diffuse)
