"""Feldman and Cousins' intervals of the length of a noisy vector: makes `processing/polarization/magnitude_table.npz`.

    python benchmarks/magnitude_table.py

takes five minutes. `processing.polarization.magnitude` says what the table holds and in which units.
"""

import numpy as np
from scipy.special import gammaincinv, ndtr

from processing.polarization.magnitude import ALONG, COMPONENTS, LEVELS, OBSERVED, SUMS, TABLE

_THETA = np.concatenate([np.arange(0, 3, 0.04), np.arange(3, 8, 0.1), np.arange(8, 14.01, 0.2)])
_R = np.arange(0, OBSERVED[-1] + 8, 0.03)
#: Quantiles at which noise across is taken, close at both ends, and their weights.
_STEPS = np.pi * (np.arange(80) + 0.5) / 80
_QUANTILES, _WEIGHTS = (1 - np.cos(_STEPS)) / 2, np.sin(_STEPS) / np.sin(_STEPS).sum()


def distribution(components: float, along: float) -> np.ndarray:
    """Distribution function (theta, r) of the observed length r of a vector of true length theta.

    r^2 = (theta + sqrt(along) z)^2 + Q, and Q, what noise adds across, is a gamma variate with the mean and variance
    that make r^2 of no vector at all have the mean `components` and the variance 2 `components`.
    """
    mean, variance = components - along, 2 * (components - along**2)
    across = gammaincinv(mean**2 / variance, _QUANTILES) * variance / mean
    length = np.sqrt(np.maximum(_R[:, None] ** 2 - across, 0)) / np.sqrt(along)
    size = _THETA / np.sqrt(along)
    return np.array([(ndtr(length - theta) - ndtr(-length - theta)) @ _WEIGHTS for theta in size])


def acceptance(cumulative: np.ndarray, level: float) -> np.ndarray:
    """Range (theta, 2) of lengths that are accepted at each theta: those of the largest likelihood ratio."""
    density = np.maximum(np.diff(cumulative, axis=1), 1e-300)
    best = density.max(axis=0)
    # Lengths that no vector has.
    ratio = np.where(best > 1e-9, density / best, 0.0)
    out = np.empty((len(_THETA), 2))
    for row, mine, each, upto in zip(out, density, ratio, cumulative, strict=True):
        order = np.argsort(-each, kind="stable")
        accepted = order[: np.searchsorted(np.cumsum(mine[order]), level) + 1]
        first = accepted.min()
        row[:] = (_R[first] if first else 0.0), np.interp(upto[first] + level, upto, _R)
    return np.asarray(np.maximum.accumulate(out, axis=0))


def node(components: float, share: float) -> np.ndarray:
    """Lower and upper bound at 68 and 95 % (4, observed)."""
    # A vector of one component has nothing across.
    cumulative = distribution(components, min(share, 0.999) * np.sqrt(components))
    out = []
    for level in LEVELS:
        low, high = acceptance(cumulative, level).T
        # theta is in the interval of r where low <= r <= high.
        out += [_lower_bound(OBSERVED, high, _THETA), np.interp(OBSERVED, low, _THETA)]
    return np.array(out)


def _lower_bound(observed: np.ndarray, high: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Lower bound, continued below zero as an odd function about where it leaves zero: so interpolation keeps that."""
    first = high[0]
    return np.interp(observed, high, theta, left=0.0) - np.interp(2 * first - observed, high, theta, left=0.0)


def sums() -> np.ndarray:
    """Lower and upper bound at 68 and 95 % (4, observed) of the sum of three equal singular values."""
    noise = np.random.default_rng(2026).normal(size=(100_000, 3, 3))
    theta = np.concatenate([np.arange(0, 8, 0.5), np.arange(8, 31, 1.0)])
    samples = [np.linalg.svd(noise + t / 3 * np.eye(3), compute_uv=False).sum(axis=1) for t in theta]
    out = []
    for level in LEVELS:
        # From an upper limit at zero to two sides, where the sum stands out.
        below = (1 - level) / 2 * (1 - np.exp(-(theta**2) / 8))
        low = [np.quantile(each, p) if p else 0.0 for each, p in zip(samples, below, strict=True)]
        high = [np.quantile(each, p + level) for each, p in zip(samples, below, strict=True)]
        out += [_lower_bound(SUMS, np.asarray(high), theta), np.interp(SUMS, low, theta)]
    return np.array(out)


if __name__ == "__main__":
    lengths = np.array([[node(n, a) for a in ALONG] for n in COMPONENTS], dtype=np.float32)
    np.savez_compressed(TABLE, lengths=lengths, sums=sums().astype(np.float32))
