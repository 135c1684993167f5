"""What noise does to coherency eigenvalues, and how to take it off: xi0 without bias, with intervals that cover.

Eigenvalues of a noisy matrix repel each other, so the largest is pushed up, most where it hardly stands out: there the
delta method fails. The height of xi0 over the mean of the other three, of a triply degenerate matrix with the noise of
the instrument, has quantiles that depend on the true height (`processing.polarization.height_quantiles`, by Monte
Carlo). They are inverted: the estimate is median-unbiased and the intervals are Neyman's. Far above the noise this is
the delta method with its second-order term.

Where the small eigenvalues differ by more than noise, the shift is that of their own gaps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.polarization.height_quantiles import true_heights
from processing.polarization.mueller import coherency

#: Of the levels of `true_heights`, in standard deviations.
_DEVIATES = np.array([-1.959964, -1.0, 0.0, 1.0, 1.959964])
#: Beyond the table the observed height is theta + 4 c^2 / theta with the noise c between dominant process and others.
_SHIFT = 4.0
#: True heights between which the table gives way to that, in units of the noise. There the process is known, and its
#: own noise says more than the average over processes of the same width.
_NEAR, _FAR = 6.0, 10.0

#: Variance of xi0 over that with m00 known, at least: errors of both that cancel are known no better.
_LEAST = 0.01

_UNITS = coherency(np.eye(16).reshape(16, 4, 4)) / 2
#: Re tr(T_a T_b T_k) of the Hermitian matrices T of single Mueller elements.
TRIPLE: NDArray[np.float64] = np.einsum("aij,bjl,kli->abk", _UNITS, _UNITS, _UNITS, optimize=True).real


@dataclass(frozen=True)
class EigenvalueNoise:
    """Noise of the coherency matrix H / (2 m00) of each pixel; arrays of the shape of an image.

    Attributes
    ----------
    along : standard error of xi0 to first order, with m00 known.
    m00 : relative standard error of m00.
    with_m00 : covariance of the relative error of m00 and that of xi0 with m00 known.
    coupling : root mean square of the elements of H between the dominant process and another.
    others : sum of squares that noise alone puts into the deviations of xi1, xi2, xi3 from their mean.
    overall : root mean square of an element of H over all directions; `coupling`, where they are alike.
    below, above : reach of xi0 within the ellipsoid of 1.96 errors over 1.96 errors to first order.
    """

    along: Array
    m00: Array
    with_m00: Array
    coupling: Array
    others: Array
    overall: Array
    below: Array | float = 1.0
    above: Array | float = 1.0

    @classmethod
    def of(
        cls, total: Array, row: Array, diagonal: Array, along: Array, *, m00: Array, with_m00: Array
    ) -> "EigenvalueNoise":
        """From second moments of the noise E of H / (2 m00) about the dominant process v.

        Parameters
        ----------
        total : E tr(E^2).
        row : v^H E[E^2] v.
        diagonal : variance of v^H E v.
        along, m00, with_m00 : as the attributes.
        """
        with np.errstate(invalid="ignore"):
            coupling = np.sqrt(np.maximum(row - diagonal, 0) / 3)
            # Of the 3 x 3 block of the others, less their mean: its trace is what m00 and v leave.
            trace = m00**2 / 2 + diagonal - 2 * with_m00
            block = total - 2 * row + diagonal
            others = np.maximum(block - trace / 3, _LEAST * block)
            overall = np.sqrt(total / 16)
        return cls(along, m00, with_m00, coupling, others, overall)

    def error_at(self, height: Array) -> Array:
        """Standard error of xi0 to first order, of a matrix of this height: M is divided by its noisy m00."""
        share = 0.75 * height
        with np.errstate(invalid="ignore"):
            variance = self.along**2 - 2 * share * self.with_m00 + (share * self.m00) ** 2
            return np.asarray(np.sqrt(np.maximum(variance, _LEAST * self.along**2)))


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


def corrected(eigenvalues: Array, noise: EigenvalueNoise, covariance: NDArray[np.float64]) -> CorrectedXi0:
    """Take the noise off observed eigenvalues (..., 4), descending, of sum 1.

    Parameters
    ----------
    covariance : (16, 16), of the elements of an ideal depolarizer, in any unit.
    """
    xi = np.asarray(eigenvalues, dtype=float)
    height = (4 * xi[..., 0] - 1) / 3
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = _heights(height, noise, covariance)
        spread, extra = _small_eigenvalues(xi, bounds[2], noise)
    values = 0.25 + 0.75 * bounds - extra
    shift = xi[..., 0] - values[2]
    # The lower bound is the height of which the observation is a high quantile.
    return CorrectedXi0(values[2], values[[3, 1]], values[[4, 0]], shift, spread)


def _heights(height: Array, noise: EigenvalueNoise, covariance: NDArray[np.float64]) -> Array:
    """True heights (5, ...) whose quantile of each of the levels is the observed one."""
    unit = noise.overall
    known = np.isfinite(height) & np.isfinite(noise.along) & (noise.along > 0)
    observed, width = np.where(known, height / unit, 0.0), np.where(known, noise.along / unit, 1.0)
    near = true_heights(covariance, observed, width)
    middle = near[2].copy()
    # What m00 adds is in proportion to the true height.
    near = middle + (near - middle) * (noise.error_at(np.maximum(middle, 0) * unit) / noise.along)
    error = 4 / 3 * noise.error_at(height) / unit
    known_process = np.clip((middle - _NEAR) / (_FAR - _NEAR), 0, 1)
    sure_process = np.clip(middle / _FAR - 1, 0, 1)
    repelled = 4 * _SHIFT * (noise.coupling / unit) ** 2
    for bound, deviate in zip(near, _DEVIATES, strict=True):
        # The upper bound is the height of which the observation is a low quantile.
        more = abs(deviate) / _DEVIATES[-1] * ((noise.above if deviate < 0 else noise.below) - 1)
        # Near 1/4 the process that is seen is that of the noise; the table knows its width alone.
        stretch = 1 + np.where(more > 0, known_process, sure_process) * more
        bound += (stretch - 1) * (bound - middle)
        far = observed - error * deviate * stretch
        beyond = (far + np.sqrt(np.maximum(far**2 - repelled, 0))) / 2
        share = np.clip((beyond - _NEAR) / (_FAR - _NEAR), 0, 1)
        bound += share * (beyond - bound)
    return np.where(known, near * unit, np.nan)


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
