"""Bounds of three eigenvalues of a noisy matrix: makes `processing/polarization/eigenvalue_table.npz`.

    python benchmarks/eigenvalue_table.py

takes five minutes. `processing.polarization.sorted_eigenvalues` says what the table holds and in which units.
"""

import itertools

import numpy as np
from scipy import optimize
from scipy.special import ndtr

from processing.polarization.sorted_eigenvalues import COMPONENTS, GAPS, LEAST_OWN, OF_MEAN, TABLE

#: True gaps at which a bound shall hold as often as it claims, and draws at each.
TRUE = (0, 0.7, 1.4, 2.2, 3, 4, 5.5, 8, 12, 20)
DRAWS, ROUNDS, LARGEST_STEP = 8000, 30, 0.4
#: Deviates of the bounds of the largest (0) and of the middle eigenvalue (1), and how smooth they are.
BOUNDS = tuple(
    (k, d, 3e-4 if abs(d) == 1 else 1e-4) for k, d in ((0, -1), (0, 1), (0, -1.96), (0, 1.96), (1, -1), (1, -1.96))
)


def fall_of(components: float) -> float:
    """Factor from one variance of an instrument's noise to the next, in 15 directions, for `COMPONENTS` of a block."""
    target, steps = 1 / (1 / 15 + 16 / 15 * (1 / components - 1 / 8)), np.arange(15)
    if target > 14.999:
        return 1.0
    return float(optimize.brentq(lambda r: np.sum(r**steps) ** 2 / np.sum(r ** (2 * steps)) - target, 1e-3, 1))


def blocks(components: float, random: np.random.Generator, draws: int = DRAWS) -> np.ndarray:
    """Projection of independent noise in 15 directions on the 8 of a block of three eigenvalues: (draws, 8, 15)."""
    directions = np.linalg.qr(random.normal(size=(draws, 15, 8)))[0]
    into = np.swapaxes(directions, 1, 2) * fall_of(components) ** (np.arange(15) / 2)
    return np.asarray(into / np.sqrt(np.square(into).sum(axis=(1, 2), keepdims=True) / 8))


def basis() -> np.ndarray:
    """Traceless Hermitian matrices (8, 3, 3), orthonormal under tr(A B)."""
    pairs = [(0, 1), (0, 2), (1, 2)]
    out = np.zeros((8, 3, 3), complex)
    for k, (i, j) in enumerate(pairs):
        out[k, i, j] = out[k, j, i] = 1 / np.sqrt(2)
        out[3 + k, i, j], out[3 + k, j, i] = -1j / np.sqrt(2), 1j / np.sqrt(2)
    out[6], out[7] = np.diag([1, -1, 0]) / np.sqrt(2), np.diag([1, 1, -2]) / np.sqrt(6)
    return out


def eigenvalues(
    first: float, second: float, random: np.random.Generator, into: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Observed deviations from the mean (draws, 3) of these true gaps, and their errors to first order, over sqrt(2/3).

    The noise `into` (draws, 8, 15) has variance 1 of an element on average over its directions.
    """
    noise = np.einsum("dai,di,ajk->djk", into, random.normal(size=into.shape[::2]), basis(), optimize=True)
    values, vectors = np.linalg.eigh(noise + np.diag([first + second, second, 0.0]))
    values, vectors = values[:, ::-1], vectors[:, :, ::-1]
    slopes = np.einsum("djk,ajl,dlk->dka", vectors.conj(), basis(), vectors, optimize=True).real
    errors = np.sqrt(1.5 * np.square(slopes @ into).sum(axis=-1))
    return values - values.mean(axis=1, keepdims=True), np.maximum(errors, LEAST_OWN)


def deviations(first: float, second: float) -> np.ndarray:
    """True deviations (3,) from the mean."""
    true = np.array([first + second, second, 0.0])
    return np.asarray(true - true.mean())


def weights(observed: np.ndarray) -> np.ndarray:
    """Weights (draws, nodes) of linear interpolation between the nodes of the table."""
    out = np.ones((len(observed), 1))
    for gap in (observed[:, 0] - observed[:, 1], observed[:, 1] - observed[:, 2]):
        hats = np.stack([np.interp(gap, GAPS, hat) for hat in np.eye(len(GAPS))], axis=1)
        out = (out[:, :, None] * hats[:, None, :]).reshape(len(observed), -1)
    return out


def bound(
    k: int, deviate: float, smooth: float, drawn: dict[tuple[float, float], tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> np.ndarray:
    """Shifts (nodes, nodes) with which the bound is above the truth as often as it claims."""
    nodes, level = len(GAPS), ndtr(deviate)
    step_of = np.diff(np.eye(nodes), axis=0)
    rough = np.concatenate([np.kron(step_of, np.eye(nodes)), np.kron(np.eye(nodes), step_of)])
    penalty, shift = smooth * rough.T @ rough, np.full(nodes**2, deviate)
    for _ in range(ROUNDS):
        misses, slopes = [], []
        for gaps, (observed, errors, plain) in drawn.items():
            interpolation = errors[:, k : k + 1] * plain
            z = (observed[:, k] + interpolation @ shift - deviations(*gaps)[k]) / np.sqrt(OF_MEAN)
            misses.append(ndtr(z).mean() - level)
            slopes.append(np.exp(-(z**2) / 2) @ interpolation / len(z) / np.sqrt(2 * np.pi * OF_MEAN))
        slope = np.array(slopes)
        right = slope.T @ np.array(misses) + penalty @ shift
        step = np.linalg.solve(slope.T @ slope + penalty + 1e-9 * np.eye(nodes**2), right)
        shift = shift - np.clip(step, -LARGEST_STEP, LARGEST_STEP)
    return np.asarray(shift.reshape(nodes, nodes))


if __name__ == "__main__":
    random, shifts = np.random.default_rng(2026), []
    for components in COMPONENTS:
        into, drawn = blocks(components, random), {}
        for gaps in itertools.product(TRUE, TRUE):
            observed, errors = eigenvalues(*gaps, random, into)
            drawn[gaps] = observed, errors, weights(observed)
        shifts.append([bound(*each, drawn) for each in BOUNDS])
        print(components)
    np.savez_compressed(TABLE, shifts=np.array(shifts, dtype=np.float32))
