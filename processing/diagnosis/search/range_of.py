"""Directions that the columns of a matrix reach, and how many of them there are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array

#: [of the largest] Singular values below this are none: half of the digits of a number.
RANK = 1e-8
#: [of the whole] A part below this is none, wherever noise is far larger.
NEARLY_ZERO = 1e-6


def range_of(a: Array) -> Array:
    """Orthonormal directions (L, rank) that the columns of a (L, K) reach."""
    u, size, _ = np.linalg.svd(a, full_matrices=False)
    return np.asarray(u[:, size > RANK * size[0]])


def inside_and_outside(a: Array) -> tuple[Array, Array]:
    """Orthonormal directions (L, rank) and (L, L - rank) that the columns of a (L, K) reach, and do not reach."""
    u, size, _ = np.linalg.svd(a, full_matrices=True)
    rank = int(np.sum(size > RANK * size[0]))
    return u[:, :rank], u[:, rank:]


def least_apart(signatures: Sequence[Array]) -> float:
    """Smallest sine between two of some signatures, each (L, its values); one where there are not two.

    It is the part of one, relative to its norm, that another does not reach. A signature of zeros is reached by all.
    """
    if len(signatures) < 2:
        return 1.0
    joined, first = np.column_stack(signatures), np.cumsum([0, *(a.shape[1] for a in signatures[:-1])])

    def norms(columns: Array) -> Array:
        return np.asarray(np.sqrt(np.add.reduceat(np.sum(columns**2, axis=0), first)))

    whole, least = norms(joined), 1.0
    for k, u in enumerate(map(range_of, signatures)):
        sines = norms(joined - u @ (u.T @ joined)) / np.where(whole > 0, whole, np.inf)
        least = min(least, float(np.delete(sines, k).min()))
    return least


def rank_of(a: Array) -> int:
    """How many directions the columns of a (L, K) reach."""
    return int(np.linalg.matrix_rank(a, rtol=RANK))
