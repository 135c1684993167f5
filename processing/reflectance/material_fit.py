"""Material constants n + i k, a, b of the polarized diffuse model from Mueller elements or Stokes vectors.

At each pixel P = alpha_0 W m0 + alpha_ID W mID, so the right constants make the measured and the modelled values most
linearly related (paper, conclusion); the two coefficients of each pixel are projected out, with alpha_0 >= 0: a
negative correlation is no agreement. In units of the noise, where it is alike in all directions, what it adds to the
sum of squares does not depend on the constants: the fit has no noise bias. A fit to dominant processes has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from processing.arrays import Array, ComplexArray
from processing.errors import NotDetermined
from processing.geometry.frames import ScatteringGeometry
from processing.reflectance import fresnel, polarized_diffuse
from processing.reflectance.base import normalized_mueller

NAMES = ("n", "k", "a", "b")
LOWER, UPPER = np.array([1.01, 0.0, 0.0, 0.3]), np.array([4.0, 4.0, 3.0, 8.0])
#: Start values; the sum of squares has more than one minimum.
STARTS = ((1.3, 0.1, 0.1, 2.0), (1.6, 0.02, 0.3, 1.5), (1.2, 0.4, 0.05, 3.0), (2.0, 1.0, 0.5, 2.0))
#: A constant counts as identified when its standard error is below this part of it (k: or below 0.02).
RELATIVE_LIMIT, K_LIMIT = 0.3, 0.02


@dataclass(frozen=True)
class MaterialFit:
    """Fitted constants.

    Attributes
    ----------
    constants : n, k, a, b.
    covariance : (4, 4); NaN for a constant at its bound. From the scatter of whole pixels, whose elements are
        correlated; it holds noise and misfit, not errors of the geometry.
    identified : which constants the data fix at all; an unidentified one may be anything.
    correlation : mean linear correlation between data and model.
    residual : root mean square of the residual over that of the data's polarized part.
    """

    constants: Array
    covariance: Array
    identified: dict[str, bool]
    condition: float
    residual: float
    correlation: float
    pixels: int

    @property
    def stderr(self) -> Array:
        """(4,), standard errors."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def notes(self, sources: Sequence[str]) -> list[str]:
        """Lines for the material file: where the constants come from, their errors and correlations."""
        errors = ", ".join(f"{name} {error:.2g}" for name, error in zip(NAMES, self.stderr, strict=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            correlation = self.covariance / np.outer(self.stderr, self.stderr)
        pairs = [(i, j) for i in range(4) for j in range(i + 1, 4) if np.isfinite(correlation[i, j])]
        between = ", ".join(f"{NAMES[i]} {NAMES[j]} {correlation[i, j]:+.2f}" for i, j in pairs)
        lost = ", ".join(name for name in NAMES if not self.identified[name])
        return [
            f"fitted to {', '.join(sources)}: {self.pixels} pixels, condition number {self.condition:.3g}",
            f"standard errors: {errors} (noise and misfit, not errors of the geometry)",
            f"correlations: {between or 'not known'}",
            *([f"NOT IDENTIFIED by these data: {lost}"] if lost else []),
        ]

    def model(self, name: str, wavelength_nm: float) -> polarized_diffuse.Model:
        """The fitted reflectance model."""
        n, k, a, b = (float(v) for v in self.constants)
        constants = {wavelength_nm: polarized_diffuse.Constants(n=n, k=k, a=a, b=b)}
        return polarized_diffuse.Model(name=name, source="process fit-material", constants=constants)


def fit_values(
    geometry: ScatteringGeometry,
    values: ArrayLike,
    rows: ArrayLike,
    covariance: ArrayLike,
    max_pixels: int = 5000,
) -> MaterialFit:
    """Constants from values that are linear in M, with correlated noise: Mueller elements or Stokes vectors.

    Parameters
    ----------
    values : (K, N), of each pixel.
    rows : (K, 16), from the Mueller matrix to the values.
    covariance : (N, K, K) of the values. Where it is made from the noisy values themselves, the weights follow the
        noise; the level of the light alone is enough.
    max_pixels : use at most so many, evenly spread.

    Raises
    ------
    NotDetermined : fewer than 10 pixels are finite.
    """
    x, c = np.asarray(values, dtype=float), np.asarray(covariance, dtype=float)
    keep = _some(np.isfinite(x).all(axis=0) & np.isfinite(c).all(axis=(1, 2)), max_pixels)
    # The ridge is for values without noise.
    ridge = 1e-9 * np.trace(c[keep], axis1=1, axis2=2)[:, None, None] * np.eye(len(x))
    whiten = np.linalg.inv(np.linalg.cholesky(c[keep] + ridge))
    data = np.einsum("nij,jn->ni", whiten, x[:, keep])
    return _fit(geometry[keep], data, whiten @ np.asarray(rows, dtype=float))


def _fit(geometry: ScatteringGeometry, data: Array, rows: Array) -> MaterialFit:
    """Fit data (N, K) in units of the noise; rows (N, K, 16) lead from the Mueller matrix to them."""
    model = _Forward(geometry)
    # What the ideal depolarizer explains is projected out of the data and of the model.
    flat = rows[:, :, 0] / np.linalg.norm(rows[:, :, 0], axis=1, keepdims=True)
    data = data - flat * np.sum(flat * data, axis=1, keepdims=True)

    def parts(q: Array) -> tuple[Array, Array]:
        modelled = np.einsum("nki,ni->nk", rows, model.mueller(q).reshape(-1, 16))
        modelled = modelled - flat * np.sum(flat * modelled, axis=1, keepdims=True)
        return modelled, np.sum(modelled * data, axis=1, keepdims=True)

    def residual(q: Array) -> Array:
        modelled, overlap = parts(q)
        size = np.maximum(np.sum(modelled**2, axis=1, keepdims=True), 1e-300)
        return np.asarray(data - modelled * np.maximum(overlap, 0) / size)

    found, jacobian = _search(residual)
    left = residual(found)
    modelled, overlap = parts(found)
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = overlap[:, 0] / (np.linalg.norm(modelled, axis=1) * np.linalg.norm(data, axis=1))
    return _result(found, jacobian, left, float(np.sqrt(np.sum(left**2) / np.sum(data**2))), float(np.nanmean(rho)))


class _Forward:
    """m0 of given directions as a function of (n, k, a, b), everything else worked out once."""

    def __init__(self, geometry: ScatteringGeometry) -> None:
        self.via_s, self.via_p = fresnel.basis(geometry)
        self.theta_d, self.sine = geometry.angles.theta_d, np.sin(geometry.angles.theta_h)
        self.diffuse = polarized_diffuse.diffuse_jones(geometry)

    def mueller(self, p: Array) -> Array:
        n, k, a, b = p
        rs, rp = fresnel.amplitudes(complex(n, k), self.theta_d)
        jones: ComplexArray = rs[:, None, None] * self.via_s + rp[:, None, None] * self.via_p
        return normalized_mueller(jones + (a * self.sine**b)[:, None, None] * self.diffuse)


def _some(good: NDArray[np.bool_], limit: int) -> NDArray[np.int64]:
    index = np.flatnonzero(good)
    if index.size < 10:
        raise NotDetermined(f"only {index.size} pixels are finite; a material fit needs 10 and more. Check the mask.")
    return index[np.linspace(0, index.size - 1, min(index.size, limit)).astype(np.int64)]


def _search(residual: Callable[[Array], Array]) -> tuple[Array, Array]:
    # Every module of this folder is imported when a material file is read, the optimizer only where it is needed.
    from scipy.optimize import least_squares

    def flat(p: Array) -> Array:
        return residual(p).reshape(-1)

    best = None
    for start in STARTS:
        fit = least_squares(flat, start, bounds=(LOWER, UPPER), x_scale=[0.1, 0.1, 0.1, 1.0], max_nfev=60)
        if best is None or fit.cost < best.cost * (1 - 1e-9):
            best = fit
    if best is None:
        raise NotDetermined("no start value led anywhere")
    return np.asarray(best.x), np.asarray(best.jac)


def _scaled(jacobian: Array) -> Array:
    return np.asarray(jacobian / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300))


def _result(found: Array, jacobian: Array, left: Array, residual: float, correlation: float) -> MaterialFit:
    width = UPPER - LOWER
    free = (found > LOWER + 1e-4 * width) & (found < UPPER - 1e-4 * width)
    singular = np.linalg.svd(_scaled(jacobian[:, free]), compute_uv=False)
    condition = float(singular[0] / max(singular[-1], 1e-300)) if free.any() else np.inf
    covariance = np.full((4, 4), np.nan)
    if free.any() and condition < 1e7:
        # A constant at its bound is not known there: without its share the others would look sure.
        prior = np.diag(np.where(free, 0.0, 1 / width**2))
        bread = np.linalg.inv(jacobian.T @ jacobian + prior)
        score = np.einsum("nkp,nk->np", jacobian.reshape(*left.shape, 4), left)
        whole = bread @ (score.T @ score + prior) @ bread
        covariance[np.ix_(free, free)] = whole[np.ix_(free, free)]
    stderr = np.sqrt(np.diag(covariance))
    limit = RELATIVE_LIMIT * np.abs(found)
    limit[1] = max(limit[1], K_LIMIT)
    # k and a may well be 0; an n at the end of its range is no surface, and what was fitted beside it means nothing.
    identified = {name: bool(s <= m and free[0]) for name, s, m in zip(NAMES, stderr, limit, strict=True)}
    return MaterialFit(found, covariance, identified, condition, residual, correlation, len(left))
