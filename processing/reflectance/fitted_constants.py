"""Fitted constants of a material: their ranges, least squares, errors, and what the data do not determine."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from processing.arrays import Array
from processing.errors import NotDetermined
from processing.reflectance.base import kinds

#: A constant counts as identified when its standard error is below this part of it; n, of n - 1.
RELATIVE_LIMIT = 0.3
#: Standard deviation of the small eigenvalues from their mean, of the sum of all four: 3 % apart, as of the paper's
#: sphere at 662 nm, is 0.012.
DEPARTURE = 0.012
#: Part of its range within which a constant is at its bound.
NEAR = 1e-4
#: Blocks of pixels in a row whose misfit may be alike.
BLOCKS = 20
#: Probability of a chi-square, were the model right, below which it is not.
UNLIKELY = 1e-3


@dataclass(frozen=True)
class Ranges:
    """Constants of a kind of material, the refractive index first.

    Attributes
    ----------
    kind : of the reflectance model.
    names, lower, upper : of the P constants, and the ends of their ranges.
    starts : start values; the sum of squares has more than one minimum.
    sizes : changes that matter about alike.
    small : standard errors below which a constant that may well be 0 is identified.
    """

    kind: str
    names: tuple[str, ...]
    lower: Array
    upper: Array
    starts: tuple[tuple[float, ...], ...]
    sizes: tuple[float, ...]
    small: tuple[float, ...]

    def inside(self, values: Array) -> NDArray[np.bool_]:
        """Which constants are not at the end of their range."""
        near = NEAR * (self.upper - self.lower)
        return np.asarray((values > self.lower + near) & (values < self.upper - near))


@dataclass(frozen=True)
class MaterialFit:
    """Fitted constants.

    Attributes
    ----------
    kind : of the reflectance model.
    names, constants : n, k, a, b; or n, alpha, albedo.
    covariance : (P, P); NaN for a constant at its bound. From the scatter of whole pixels, of blocks of them where the
        model does not describe the data; it holds noise and misfit, not errors of the geometry.
    departure : (P, P), covariance by small eigenvalues that differ; zero where they do not matter.
    systematic : (P, P), covariance by the instrument's uncertainty; zero where none is stated.
    identified : which constants the data fix at all; an unidentified one may be anything.
    correlation : mean linear correlation between data and model; NaN for the dominant process.
    residual : root mean square of the residual over that of the data's polarized part; NaN likewise.
    chi_square : what neither the model nor the instrument's uncertainty describes, over the noise; 1: noise alone.
    describes : whether noise makes such a chi-square.
    method : "dominant process", "linear correlation" or "sum of two processes".
    """

    kind: str
    names: tuple[str, ...]
    constants: Array
    covariance: Array
    departure: Array
    systematic: Array
    identified: dict[str, bool]
    condition: float
    residual: float
    correlation: float
    chi_square: float
    describes: bool
    method: str
    pixels: int

    @property
    def stderr(self) -> Array:
        """(P,), standard errors."""
        return np.asarray(np.sqrt(np.diag(self.covariance + self.departure + self.systematic)))

    def notes(self, sources: Sequence[str]) -> list[str]:
        """Lines for the material file: where the constants come from, their errors and correlations."""
        errors = ", ".join(f"{name} {error:.2g}" for name, error in zip(self.names, self.stderr, strict=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            correlation = self.covariance / np.outer(self.stderr, self.stderr)
        pairs = [pair for pair in combinations(range(len(self.names)), 2) if np.isfinite(correlation[pair])]
        between = ", ".join(f"{self.names[i]} {self.names[j]} {correlation[i, j]:+.2f}" for i, j in pairs)
        lost = ", ".join(name for name in self.names if not self.identified[name])
        return [
            f"fitted to {', '.join(sources)} by the {self.method}",
            f"{self.pixels} pixels, condition number {self.condition:.3g}",
            f"standard errors: {errors} (noise, misfit and instrument, not errors of the geometry)",
            *self._doubts,
            f"correlations: {between or 'not known'}",
            *([f"NOT IDENTIFIED by these data: {lost}"] if lost else []),
        ]

    @property
    def _doubts(self) -> list[str]:
        doubts = []
        if not self.describes:
            doubts.append(f"THE MODEL DOES NOT DESCRIBE THESE DATA: reduced chi-square {self.chi_square:.3g}")
        apart = f"small eigenvalues {250 * DEPARTURE:.0f} % apart, which a Mueller image does not have"
        for source, part in ((apart, self.departure), ("the instrument's uncertainty", self.systematic)):
            if part.any():
                by = ", ".join(f"{n} {e:.2g}" for n, e in zip(self.names, np.sqrt(np.diag(part)), strict=True))
                doubts.append(f"of these, {source}: {by}")
        return doubts

    def model(self, name: str, wavelength_nm: float) -> BaseModel:
        """The fitted reflectance model."""
        constants = {wavelength_nm: dict(zip(self.names, map(float, self.constants), strict=True))}
        fields = {"kind": self.kind, "name": name, "source": "process fit-material", "constants": constants}
        return kinds()[self.kind].model_validate(fields)


def evenly(good: NDArray[np.bool_], limit: int) -> NDArray[np.int64]:
    """Indices of at most `limit` good pixels, evenly spread. Raises NotDetermined where fewer than 10 are."""
    index = np.flatnonzero(good)
    if index.size < 10:
        raise NotDetermined(f"only {index.size} pixels are finite; a material fit needs 10 and more. Check the mask.")
    return index[np.linspace(0, index.size - 1, min(index.size, limit)).astype(np.int64)]


def search(residual: Callable[[Array], Array], of: Ranges, near: Array | None = None) -> tuple[Array, Array]:
    """Constants of least squares and the derivatives (N, P) there: from `near`, or from all starts."""
    # Every module of this folder is imported when a material file is read, the optimizer only where it is needed.
    from scipy.optimize import least_squares

    def flat(p: Array) -> Array:
        return residual(p).reshape(-1)

    best = None
    for start in of.starts if near is None else (near,):
        fit = least_squares(flat, start, bounds=(of.lower, of.upper), x_scale=of.sizes, max_nfev=60)
        if best is None or fit.cost < best.cost * (1 - 1e-9):
            best = fit
    if best is None:
        raise NotDetermined("no start value led anywhere")
    return np.asarray(best.x), np.asarray(best.jac)


def unexplained_square(residual: Array, changes: Sequence[Array]) -> float:
    """Sum of squares of a residual in units of the noise, where each of `changes` may be in it, of unit variance."""
    square = float(np.sum(residual**2))
    if not changes:
        return square
    flat = np.array([change.reshape(-1) for change in changes])
    along = flat @ residual.reshape(-1)
    return square - float(along @ np.linalg.solve(np.eye(len(flat)) + flat @ flat.T, along))


def result_of(
    constants: Array,
    curvature: Array,
    scores: Array,
    square: float,
    *,
    free: int,
    method: str,
    off: Array,
    departures: Array | None = None,
    of: Ranges,
) -> MaterialFit:
    """A fit from the curvature (P, P) of its sum and the slopes (N, P) of the pixels.

    `square`, of `free` numbers, is what it does not describe in units of the noise; `off` (D, P) is what each
    uncertain input of the instrument does to the constants, `departures` are slopes by what the model leaves out.
    """
    from scipy.special import chdtrc

    pixels, width, inside = len(scores), of.upper - of.lower, of.inside(constants)
    size = np.sqrt(np.maximum(np.diag(curvature), 1e-300))
    values = np.linalg.eigvalsh((curvature / np.outer(size, size))[np.ix_(inside, inside)])
    condition = float(np.sqrt(values[-1] / max(values[0], 1e-300))) if inside.any() else np.inf
    describes = bool(chdtrc(free, square) > UNLIKELY)
    if not describes:
        block = np.arange(len(scores)) * BLOCKS // len(scores)
        scores = np.stack([scores[block == k].sum(axis=0) for k in range(BLOCKS)])
    covariance, departure = np.full_like(curvature, np.nan), np.zeros_like(curvature)
    if inside.any() and condition < 1e7:
        # A constant at its bound is not known there: without its share the others would look sure.
        bread = np.linalg.inv(curvature + np.diag(np.where(inside, 0.0, 1 / width**2)))
        prior = np.diag(np.where(inside, 0.0, 1 / width**2))
        full = bread @ (scores.T @ scores + prior) @ bread
        covariance[np.ix_(inside, inside)] = full[np.ix_(inside, inside)]
        if departures is not None:
            departure = bread @ departures.T @ departures @ bread
    systematic = off.T @ off
    stderr = np.sqrt(np.diag(covariance + departure + systematic))
    # What n does to light is in proportion to n - 1, and so is its error.
    effect = np.abs(constants - np.eye(len(constants))[0])
    limit = np.maximum(RELATIVE_LIMIT * effect, of.small)
    # k and a may well be 0. An n at the end of its range is no surface, and errors to first order hold about one n.
    # Linear light sees k by its square: at k = 0 the errors of the others have no share of it.
    is_regular = inside[0] if departures is None else inside.all()
    fixed = (stderr <= limit) & is_regular & (stderr[0] <= limit[0])
    identified = dict(zip(of.names, fixed.tolist(), strict=True))
    return MaterialFit(
        kind=of.kind,
        names=of.names,
        constants=constants,
        covariance=covariance,
        departure=departure,
        systematic=systematic,
        identified=identified,
        condition=condition,
        residual=np.nan,
        correlation=np.nan,
        chi_square=square / max(free, 1),
        describes=describes,
        method=method,
        pixels=pixels,
    )
