"""Cloude decomposition of Mueller images: coherency eigenvalues, dominant process and xi0.

A Mueller matrix is a sum of four Mueller-Jones matrices, M = m00 (xi0 m0 + xi1 m1 + xi2 m2 + xi3 m3), weighted by
the eigenvalues of its coherency matrix divided by its trace (paper, Sec. II; docs/conventions.md, "Coherency matrix").
"""

from typing import NamedTuple

import numpy as np

from processing.arrays import RealArray
from processing.computing.chunks import for_chunks
from processing.polarization import coherency_kernels as kernels


class Cloude(NamedTuple):
    """Cloude decomposition: M = m00 sum_k xi_k m_k."""

    eigenvalues: RealArray
    """(..., 4), descending, sum 1."""
    mueller_jones: RealArray
    """(..., 4, 4, 4): the matrix of each eigenvalue, m00 = 1."""


def coherency_eigenvalues(m: RealArray) -> RealArray:
    """Eigenvalues xi0 >= xi1 >= xi2 >= xi3 of the coherency matrices of Mueller matrices, divided by their trace.

    Parameters
    ----------
    m : (..., 4, 4), float32 or float64. A planar image (16, rows, columns) goes in without a copy as
        `np.moveaxis(image.reshape(4, 4, rows, columns), (0, 1), (-2, -1))`.

    Returns
    -------
    (..., 4) of the same type, sum 1. A negative eigenvalue means an unphysical matrix (noise) and stays.
    NaN where m00 <= 0 or an element is not finite.
    """
    planar, shape = as_planar(m)
    xi = np.empty((4, planar.shape[1]), planar.dtype)
    for_chunks(kernels.eigenvalues, planar, xi)
    return np.moveaxis(xi.reshape(4, *shape), 0, -1)


def cloude(m: RealArray) -> Cloude:
    """All four eigenvalues and Mueller-Jones matrices of Mueller matrices (..., 4, 4).

    Where eigenvalues are equal their matrices are one choice of many (any basis of their common space); an exact ideal
    depolarizer has none and gets NaN.

    Parameters
    ----------
    m : array (..., 4, 4)

    Returns
    -------
    Cloude
        Values and NaN as in `coherency_eigenvalues`.

    Examples
    --------
    >>> import numpy as np
    >>> cloude(np.diag([1, 0.5, 0.5, 0.5])).eigenvalues.round(3).tolist()
    [0.625, 0.125, 0.125, 0.125]
    """
    planar, shape = as_planar(m)
    xi = np.empty((4, planar.shape[1]), planar.dtype)
    parts = np.empty((4, 16, planar.shape[1]), planar.dtype)
    for_chunks(kernels.eigensystem, planar, xi, parts)
    matrices = np.moveaxis(parts.reshape(4, 4, 4, *shape), (0, 1, 2), (-3, -2, -1))
    return Cloude(np.moveaxis(xi.reshape(4, *shape), 0, -1), matrices)


def xi0_and_dominant(m: RealArray, out: tuple[RealArray, RealArray] | None = None) -> tuple[RealArray, RealArray]:
    """Largest coherency eigenvalue xi0 and the dominant Mueller-Jones matrix m0.

    Newton's method on the characteristic polynomial and the adjugate, in float64; where the largest eigenvalues
    are closer than about 1e-3 of the spread of all four, Jacobi rotations.

    Parameters
    ----------
    m : (..., 4, 4), float32 or float64, as in `coherency_eigenvalues`.
    out
        What an earlier call for the same shape returned, to fill again: the first touch of new memory costs as much
        as the arithmetic.

    Returns
    -------
    xi0 : (...), same type. 1 for a Mueller-Jones matrix, 1/4 for the ideal depolarizer.
    mueller_jones : (..., 4, 4), m00 = 1. NaN where m00 <= 0 or an element is not finite, and for an exact ideal
        depolarizer, which has no dominant process.

    Examples
    --------
    >>> import numpy as np
    >>> xi0, process = xi0_and_dominant(np.diag([1, 0.5, 0.5, 0.5]))
    >>> float(xi0), np.diag(process).round(6).tolist()
    (0.625, [1.0, 1.0, 1.0, 1.0])
    """
    planar, shape = as_planar(m)
    if out is None:
        xi0, m0 = np.empty(planar.shape[1], planar.dtype), np.empty((16, planar.shape[1]), planar.dtype)
    else:
        xi0, m0 = out[0].reshape(-1), np.moveaxis(out[1], (-2, -1), (0, 1)).reshape(16, -1)
        if xi0.size != planar.shape[1] or not (np.shares_memory(xi0, out[0]) and np.shares_memory(m0, out[1])):
            raise ValueError("`out` must be what an earlier call for the same shape returned")
    for_chunks(kernels.dominant, planar, xi0, m0)
    return xi0.reshape(shape), np.moveaxis(m0.reshape(4, 4, *shape), (0, 1), (-2, -1))


def as_planar(m: RealArray) -> tuple[RealArray, tuple[int, ...]]:
    """View m as (16, pixels), C- or Fortran-ordered, copying only where its memory is neither."""
    m = np.asarray(m)
    if m.shape[-2:] != (4, 4):
        raise ValueError(f"Mueller matrices have shape (..., 4, 4); got {m.shape}")
    if m.dtype not in (np.float32, np.float64):
        m = m.astype(np.float64)
    shape = m.shape[:-2]
    pixel_major = m.flags.c_contiguous
    if pixel_major:
        return m.reshape(-1, 16).T, shape
    return np.ascontiguousarray(np.moveaxis(m, (-2, -1), (0, 1))).reshape(16, -1), shape
