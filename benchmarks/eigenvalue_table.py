"""Bounds of three eigenvalues of a noisy matrix: makes `processing/polarization/eigenvalue_table.npz`.

    python benchmarks/eigenvalue_table.py

takes a minute. `processing.polarization.sorted_eigenvalues` says what the table holds and in which units.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.special import ndtr

from processing.polarization.sorted_eigenvalues import GAPS, OF_MEAN, TABLE

#: True gaps at which a bound shall hold as often as it claims, and draws at each.
TRUE = (0, 0.7, 1.4, 2.2, 3, 4, 5.5, 8, 12, 20)
DRAWS, ROUNDS, LARGEST_STEP = 8000, 30, 0.4
#: Deviates of the bounds of the largest (0) and of the middle eigenvalue (1), and how smooth they are.
BOUNDS = tuple(
    (k, d, 1e-3 if abs(d) == 1 else 1e-4) for k, d in ((0, -1), (0, 1), (0, -1.96), (0, 1.96), (1, -1), (1, -1.96))
)


def eigenvalues(first: float, second: float, random: np.random.Generator, draws: int = DRAWS) -> np.ndarray:
    """Observed deviations (draws, 3) from the mean, of these true gaps, under noise of variance 1 of each element."""
    parts = random.normal(size=(2, draws, 3, 3)) / np.sqrt(2)
    noise = parts[0] + 1j * parts[1]
    noise = (noise + np.conj(np.swapaxes(noise, 1, 2))) / np.sqrt(2)
    found = np.linalg.eigvalsh(noise + np.diag([first + second, second, 0.0]))[:, ::-1]
    return np.asarray(found - found.mean(axis=1, keepdims=True))


def deviations(first: float, second: float) -> np.ndarray:
    """True deviations (3,) from the mean."""
    true = np.array([first + second, second, 0.0])
    return np.asarray(true - true.mean())


def weights(seen: np.ndarray) -> np.ndarray:
    """Weights (draws, nodes) of linear interpolation between the nodes of the table."""
    out = np.ones((len(seen), 1))
    for gap in (seen[:, 0] - seen[:, 1], seen[:, 1] - seen[:, 2]):
        hats = np.stack([np.interp(gap, GAPS, hat) for hat in np.eye(len(GAPS))], axis=1)
        out = (out[:, :, None] * hats[:, None, :]).reshape(len(seen), -1)
    return out


def bound(
    k: int, deviate: float, smooth: float, drawn: dict[tuple[float, float], tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """Shifts (nodes, nodes) with which the bound is above the truth as often as it claims."""
    nodes, level = len(GAPS), ndtr(deviate)
    step_of = np.diff(np.eye(nodes), axis=0)
    rough = np.concatenate([np.kron(step_of, np.eye(nodes)), np.kron(np.eye(nodes), step_of)])
    penalty, shift = smooth * rough.T @ rough, np.full(nodes**2, deviate)
    for _ in range(ROUNDS):
        misses, slopes = [], []
        for gaps, (seen, between) in drawn.items():
            z = (seen[:, k] + between @ shift - deviations(*gaps)[k]) / np.sqrt(OF_MEAN)
            misses.append(ndtr(z).mean() - level)
            slopes.append(np.exp(-(z**2) / 2) @ between / len(z) / np.sqrt(2 * np.pi * OF_MEAN))
        slope = np.array(slopes)
        right = slope.T @ np.array(misses) + penalty @ shift
        step = np.linalg.solve(slope.T @ slope + penalty + 1e-9 * np.eye(nodes**2), right)
        shift = shift - np.clip(step, -LARGEST_STEP, LARGEST_STEP)
    return np.asarray(shift.reshape(nodes, nodes))


if __name__ == "__main__":
    random = np.random.default_rng(2026)
    seen = {gaps: eigenvalues(*gaps, random) for gaps in itertools.product(TRUE, TRUE)}
    drawn = {gaps: (values, weights(values)) for gaps, values in seen.items()}
    np.savez(TABLE, shifts=np.array([bound(*each, drawn) for each in BOUNDS], dtype=np.float32))
