"""What noise of an instrument makes of the largest coherency eigenvalue: quantiles by Monte Carlo, and their inverse.

A triply degenerate matrix of true height theta (1 for a Mueller-Jones matrix, 0 for the ideal depolarizer) and noise
shows a height x = (4 xi0 - 1)/3. Where noise is not alike in all directions, the process that is found near theta = 0
is likely to be that of a noisy direction, so x alone does not tell enough. Quantiles of x are therefore those among
matrices that show the same width: the standard error of xi0 about the process that was found. Unknown true processes
are drawn evenly from all Mueller-Jones matrices. All numbers are in units of the noise of one element of the coherency
matrix, root mean square over all directions, so that one table serves every pixel of an instrument.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.polarization.cloude import xi0_and_dominant
from processing.polarization.length_kernels import interpolate
from processing.polarization.mueller import coherency_to_mueller

#: Probabilities of the quantiles: two-sided 95 and 68 % about the median.
LEVELS = np.array([0.025, 0.15865525, 0.5, 0.84134475, 0.975])
#: True heights, in units of the noise.
THETA = np.concatenate([np.arange(0, 4, 0.5), np.arange(4, 8.1, 1), np.arange(10, 14.1, 2)])
#: Matrices a true height, and how many of them at least, those of the nearest widths, give the quantiles at one width.
DRAWS, NEXT = 12_000, 1200
#: Sum of the variances of the elements of M / m00 where those of the coherency matrix have variance 1.
_UNIT = 64.0
#: Grid of the inverted table: width by equal factors, and observed height by equal steps.
_LEAST_WIDTH, _FACTOR, _WIDTHS = 0.1, 1.15, 30
_LEAST_X, _STEP, _XS = -20.0, 0.1, 450


def true_heights(covariance: NDArray[np.float64], observed: Array, width: Array) -> Array:
    """True heights (5, ...) of which the observed one is the quantile of each of `LEVELS`.

    Parameters
    ----------
    covariance : (16, 16), of the elements of an ideal depolarizer, in any unit.
    observed, width : (...), height and standard error of xi0 with m00 known, both over the noise.
    """
    shape = covariance * (_UNIT / np.trace(covariance))
    table = _inverted(np.ascontiguousarray(shape).tobytes())
    at = np.stack([np.log(width / _LEAST_WIDTH) / np.log(_FACTOR), (observed - _LEAST_X) / _STEP])
    found = np.empty((len(LEVELS), observed.size))
    interpolate(table, np.maximum(np.concatenate([0 * at[:1], at]), 0).reshape(3, -1), found)
    return found.reshape(-1, *observed.shape)


@lru_cache(maxsize=8)
def _inverted(shape: bytes) -> NDArray[np.float64]:
    """True height (1, widths, observed, levels) of which the observed one is the quantile of each level."""
    quantiles = _quantiles(np.frombuffer(shape).reshape(16, 16))
    x = _LEAST_X + _STEP * np.arange(_XS)
    heights = np.concatenate([-THETA[:0:-1], THETA])
    # Below 0 the table is continued as an odd function: an estimate may fall below the ideal depolarizer, and must
    # where its mean is to be right.
    observed = np.maximum.accumulate(np.concatenate([2 * quantiles[0] - quantiles[:0:-1], quantiles]))
    table = np.array([[np.interp(x, one, heights) for one in level] for level in np.moveaxis(observed, 0, -1)])
    return np.ascontiguousarray(np.moveaxis(table, 0, -1)[None])


def _quantiles(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quantiles (heights, levels, widths) of the observed height, by noise of this covariance (16, 16)."""
    random = np.random.default_rng(2026)
    # A height of zero does not feel the noise of m00; `EigenvalueNoise` knows what it does to others.
    elements = covariance[1:, 1:]
    values, vectors = np.linalg.eigh(elements)
    noise = (random.normal(size=(DRAWS, 15)) * np.sqrt(np.maximum(values, 0))) @ vectors.T
    process = _processes(random)
    widths = _LEAST_WIDTH * _FACTOR ** np.arange(_WIDTHS)
    found = np.empty((len(THETA), len(LEVELS), len(widths)))
    matrices = np.ones((DRAWS, 16))
    for theta, quantiles in zip(THETA, found, strict=True):
        matrices[:, 1:] = noise + theta * process
        xi0, m0 = xi0_and_dominant(matrices.reshape(-1, 4, 4))
        dominant = m0.reshape(-1, 16)[:, 1:]
        width = np.sqrt(np.einsum("pi,pi->p", dominant @ elements, dominant)) / 4
        order = np.argsort(width, kind="stable")
        width, observed = width[order], ((4 * xi0 - 1) / 3)[order]
        left, right = np.searchsorted(width, [widths / _FACTOR, widths * _FACTOR])
        firsts = np.clip(np.minimum(left, (left + right - NEXT) // 2), 0, DRAWS - NEXT)
        for k, (first, last) in enumerate(zip(firsts, np.maximum(right, firsts + NEXT), strict=True)):
            near = slice(first, last)
            at = np.quantile(observed[near], LEVELS)
            # Beyond the widths that this noise has at the ideal depolarizer, of brighter or darker states.
            quantiles[:, k] = at[2] + (at - at[2]) * (widths[k] / width[near].mean())
    return found


def _processes(random: np.random.Generator) -> NDArray[np.float64]:
    """Elements (DRAWS, 15) other than m00 = 1 of Mueller-Jones matrices, even over all Jones matrices."""
    parts = random.normal(size=(2, DRAWS, 4))
    jones = parts[0] + 1j * parts[1]
    m = coherency_to_mueller(jones[:, :, None] * jones[:, None, :].conj()).reshape(-1, 16)
    return np.asarray(m[:, 1:] / m[:, :1])
