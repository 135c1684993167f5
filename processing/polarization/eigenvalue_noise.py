"""What noise does to coherency eigenvalues, and how to take it off: xi0 without bias, with intervals that cover.

Eigenvalues of a noisy matrix repel each other, so the largest is pushed up, most where it hardly stands out: there the
delta method fails. For a triply degenerate matrix with noise alike in all directions the height of xi0 over the mean of
the other three, in units of the noise s of one element of the coherency matrix, depends on one number only, the true
height theta. Its quantiles, by Monte Carlo (`benchmarks/eigenvalue_quantiles.py`), are inverted: the estimate is
median-unbiased and the intervals are Neyman's. Far above the noise this is the delta method with its second-order term.

Noise that is not alike in all directions enters through two variances: along the dominant process (width), and between
it and the others (shift). Where the small eigenvalues differ by more than noise, the shift is that of their own gaps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from processing.arrays import Array
from processing.polarization.mueller import coherency

#: Probabilities of the quantiles: two-sided 95 and 68 % about the median.
LEVELS = np.array([0.025, 0.15865525, 0.5, 0.84134475, 0.975])
_DEVIATES = np.array([-1.959964, -1.0, 0.0, 1.0, 1.959964])
#: True heights of the table, in units of the noise.
THETA = np.concatenate([np.arange(0, 8, 0.5), np.arange(8, 20.1, 2)])
#: Spread and shift of the observed height beyond the table: sqrt(1 + 1/3), and 4 / theta.
_SPREAD, _SHIFT = np.sqrt(4 / 3), 4.0
_QUANTILES = np.array([
    [2.067, 2.643, 3.328, 4.100, 4.911],  # 0
    [2.086, 2.662, 3.351, 4.130, 4.945],  # 0.5
    [2.125, 2.713, 3.420, 4.225, 5.071],  # 1
    [2.194, 2.803, 3.546, 4.377, 5.245],  # 1.5
    [2.301, 2.948, 3.731, 4.611, 5.529],  # 2
    [2.446, 3.131, 3.971, 4.901, 5.843],  # 2.5
    [2.621, 3.373, 4.262, 5.240, 6.226],  # 3
    [2.836, 3.644, 4.598, 5.621, 6.638],  # 3.5
    [3.103, 3.975, 4.968, 6.009, 7.037],  # 4
    [3.421, 4.346, 5.367, 6.431, 7.464],  # 4.5
    [3.781, 4.735, 5.786, 6.865, 7.918],  # 5
    [4.162, 5.141, 6.213, 7.309, 8.363],  # 5.5
    [4.554, 5.572, 6.656, 7.757, 8.829],  # 6
    [4.985, 6.011, 7.108, 8.224, 9.290],  # 6.5
    [5.411, 6.455, 7.563, 8.677, 9.754],  # 7
    [5.863, 6.917, 8.027, 9.147, 10.220],  # 7.5
    [6.320, 7.381, 8.494, 9.623, 10.707],  # 8
    [8.179, 9.270, 10.397, 11.535, 12.616],  # 10
    [10.103, 11.191, 12.335, 13.479, 14.555],  # 12
    [12.045, 13.140, 14.286, 15.426, 16.532],  # 14
    [14.013, 15.101, 16.247, 17.398, 18.497],  # 16
    [15.970, 17.073, 18.224, 19.375, 20.483],  # 18
    [17.944, 19.055, 20.201, 21.342, 22.461],  # 20
])  # fmt: skip

#: Grid of the inverted table: observed height, and width over that of noise alike in all directions.
_X = np.arange(-20.0, 25.0, 0.1)
_WIDTH = np.arange(0.2, 8.01, 0.1)
#: Noise this many times as large over all directions as about the dominant process may itself have made that process.
_UNLIKE = 1.2


def _inverted() -> NDArray[np.float64]:
    """True height (levels, widths, observed) of which the observed one is the quantile of each level."""
    # Below 0 the table is continued as an odd function: an estimate may fall below the ideal depolarizer, and must
    # where its mean is to be right.
    heights = np.concatenate([-THETA[:0:-1], THETA])
    observed = np.concatenate([2 * _QUANTILES[0] - _QUANTILES[:0:-1], _QUANTILES])
    median = observed[:, 2]
    return np.array(
        [[np.interp(_X, median + width * (column - median), heights) for width in _WIDTH] for column in observed.T]
    )


_INVERTED = _inverted()

_UNITS = coherency(np.eye(16).reshape(16, 4, 4)) / 2
#: Re tr(T_a T_b T_k) of the Hermitian matrices T of single Mueller elements.
TRIPLE: NDArray[np.float64] = np.einsum("aij,bjl,kli->abk", _UNITS, _UNITS, _UNITS, optimize=True).real


@dataclass(frozen=True)
class EigenvalueNoise:
    """Noise of the coherency matrix H / (2 m00) of each pixel; arrays of the shape of an image.

    Attributes
    ----------
    along : standard error of xi0 to first order.
    coupling : root mean square of the elements of H between the dominant process and another.
    others : sum of squares that noise alone puts into the deviations of xi1, xi2, xi3 from their mean.
    overall : root mean square of an element of H over all directions; `coupling`, where they are alike.
    """

    along: Array
    coupling: Array
    others: Array
    overall: Array

    @classmethod
    def of(cls, total: Array, row: Array, diagonal: Array, along: Array) -> EigenvalueNoise:
        """From second moments of the noise E of H / (2 m00) about the dominant process v.

        Parameters
        ----------
        total : E tr(E^2).
        row : v^H E[E^2] v.
        diagonal : variance of v^H E v.
        along : standard error of xi0; differs from sqrt(diagonal) by the noise of m00.
        """
        with np.errstate(invalid="ignore"):
            coupling = np.sqrt(np.maximum(row - diagonal, 0) / 3)
            # In the 3 x 3 block of the others 9 numbers are noise; 1 is their mean.
            others = np.maximum(total - 2 * row + diagonal, 0) * (8 / 9)
            overall = np.sqrt(total / 15)
        return cls(along, coupling, others, overall)


@dataclass(frozen=True)
class CorrectedXi0:
    """xi0 of each pixel with the noise taken off.

    Attributes
    ----------
    xi0 : median-unbiased; may lie below 1/4 or above 1, which is noise, and is not clipped.
    interval_68, interval_95 : (2, ...), lower and upper bound.
    shift : what was taken off the observed eigenvalue.
    spread : root of the sum of squares of xi1, xi2, xi3 minus their mean, without noise; 0 where noise explains it.
    """

    xi0: Array
    interval_68: Array
    interval_95: Array
    shift: Array
    spread: Array

    @property
    def stderr(self) -> Array:
        """Of xi0: within one and 1.96 of it lie the whole 68 and 95 % interval, and below 1/4 that limit itself.

        Half the 68 % interval where that is even. Near 1/4 it is not, and half of it would cover half of the truths.
        """
        farthest = [np.abs(bounds - self.xi0).max(axis=0) for bounds in (self.interval_68, self.interval_95)]
        # No sample lies below 1/4: an estimate there is off by that much at least.
        return np.asarray(np.maximum(farthest[0], np.maximum(farthest[1], 0.25 - self.xi0) / _DEVIATES[-1]))


def corrected(eigenvalues: Array, noise: EigenvalueNoise) -> CorrectedXi0:
    """Take the noise off observed eigenvalues (..., 4), descending, of sum 1."""
    xi = np.asarray(eigenvalues, dtype=float)
    height = (4 * xi[..., 0] - 1) / 3
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = _scaled_heights(height, noise.along, noise.coupling)
        # States of poor condition: where one direction is noisier, the process found is likely to be that of its noise.
        unlike = noise.overall > _UNLIKE * noise.coupling
        others = _scaled_heights(height[unlike], noise.along[unlike], noise.overall[unlike])
        bounds[:2, unlike] = np.maximum(bounds[:2, unlike], others[:2])
        bounds[3:, unlike] = np.minimum(bounds[3:, unlike], others[3:])
        spread, extra = _small_eigenvalues(xi, bounds[2], noise)
    values = 0.25 + 0.75 * bounds - extra
    shift = xi[..., 0] - values[2]
    # The lower bound is the height of which the observation is a high quantile.
    return CorrectedXi0(values[2], values[[3, 1]], values[[4, 0]], shift, spread)


def _scaled_heights(height: Array, along: Array, noise: Array) -> Array:
    """`_heights` of heights with this noise of an element of H, in their own unit."""
    # The table's own noise has a first-order width of sqrt(3)/2 in xi0.
    return _heights(height / noise, along / (np.sqrt(0.75) * noise)) * noise


def _heights(observed: Array, width: Array) -> Array:
    """True heights (5, ...) whose quantile of each of `LEVELS` is the observed one."""
    known = np.isfinite(observed) & np.isfinite(width)
    at = np.stack([np.where(known, width - _WIDTH[0], 0) / 0.1, np.where(known, observed - _X[0], 0) / 0.1])
    found = np.empty((len(LEVELS), *observed.shape))
    for k, deviate in enumerate(_DEVIATES):
        far = observed - _SPREAD * width * deviate
        beyond = (far + np.sqrt(np.maximum(far**2 - 4 * _SHIFT, 0))) / 2
        near = map_coordinates(_INVERTED[k], at, order=1, mode="nearest")
        found[k] = np.where(beyond > THETA[-1] - 4, beyond, near)
    return np.where(known, found, np.nan)


def _small_eigenvalues(xi: Array, height: Array, noise: EigenvalueNoise) -> tuple[Array, Array]:
    """Spread of the small eigenvalues without noise, and what it adds to the shift of xi0."""
    deviation = xi[..., 1:] - xi[..., 1:].mean(axis=-1, keepdims=True)
    observed = np.sum(deviation**2, axis=-1)
    left = np.maximum(observed - noise.others, 0)
    real = deviation * np.sqrt(left / np.where(observed > 0, observed, 1))[..., None]
    # Eigenvalues closer than the noise repel no more strongly than at that distance.
    least = 2 * noise.coupling[..., None]
    gaps = np.maximum(height[..., None] - real, least)
    even = np.maximum(height, least[..., 0])
    extra = noise.coupling**2 * (np.sum(1 / gaps, axis=-1) - 3 / even)
    return np.sqrt(left), extra
