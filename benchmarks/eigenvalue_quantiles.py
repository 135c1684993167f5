"""Quantiles of the largest coherency eigenvalue under noise: the table in `processing.polarization.eigenvalue_noise`.

    python benchmarks/eigenvalue_quantiles.py [--draws 200000]

Prints, for each height theta of the dominant process over the other three, the quantiles of the height observed. Both
are in units of the noise of one element of the coherency matrix.
"""

from __future__ import annotations

import argparse

import numpy as np

from processing.polarization.eigenvalue_noise import LEVELS, THETA

BATCH = 50_000


def observed(theta: float, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Heights (draws,) of the largest eigenvalue of theta e e^H + noise over the mean of the other three."""
    found = []
    for _ in range(-(-draws // BATCH)):
        a = rng.normal(size=(BATCH, 4, 4)) + 1j * rng.normal(size=(BATCH, 4, 4))
        h = (a + np.swapaxes(a.conj(), 1, 2)) / 2
        h[:, 0, 0] += theta
        values = np.linalg.eigvalsh(h)
        found.append(values[:, 3] - values[:, :3].mean(axis=1))
    return np.concatenate(found)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200_000)
    arguments = parser.parse_args()
    generator = np.random.default_rng(2026)
    for height in THETA:
        row = np.quantile(observed(float(height), arguments.draws, generator), LEVELS)
        print("    [" + ", ".join(f"{value:.3f}" for value in row) + f"],  # {height:g}", flush=True)
