"""Mueller matrices that are drawn at random."""

import numpy as np

from processing.arrays import Array
from processing.polarization import mueller


def random_mueller(count: int, seed: int, spread: float = 2.0) -> Array:
    """Physical matrices, of four processes each, from nearly pure to strongly depolarizing, of random throughput."""
    rng = np.random.default_rng(seed)
    jones = rng.normal(size=(count, 4, 2, 2)) + 1j * rng.normal(size=(count, 4, 2, 2))
    weights = rng.exponential(size=(count, 4, 1, 1)) ** spread
    return np.asarray((mueller.from_jones(jones) * weights).sum(axis=1))
