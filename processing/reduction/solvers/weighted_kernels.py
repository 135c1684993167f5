"""Loops over many small symmetric systems, one for each pixel, behind `processing.reduction.solvers.weighted`.

Packed symmetric 16 x 16 matrices are rows (136, pixels), lower triangle row by row. Pixels are handled in tiles
so that every inner loop runs along pixels and becomes vector instructions; arithmetic is in float64.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.compiling import compiled, in_parts

ELEMENTS = 16
PACKED = ELEMENTS * (ELEMENTS + 1) // 2
# Long enough for vector instructions, short enough that 136 rows of float64 stay close to the core.
TILE = 64
# A pivot below this part of its diagonal element: the remaining states do not determine the pixel.
SMALLEST_PIVOT = 1e-9

_EXACT: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}
_jit = compiled(**_EXACT)


@_jit
def _at(i, j):  # type: ignore[no-untyped-def]
    return i * (i + 1) // 2 + j


@_jit
def _cholesky(a, bad):  # type: ignore[no-untyped-def]
    """a = L in place of the matrix, its diagonal inverted; bad (TILE,) is set where a pivot vanishes."""
    for i in range(16):
        for j in range(i):
            ij = _at(i, j)
            for k in range(j):
                ik, jk = _at(i, k), _at(j, k)
                for t in range(TILE):
                    a[ij, t] -= a[ik, t] * a[jk, t]
            jj = _at(j, j)
            for t in range(TILE):
                a[ij, t] *= a[jj, t]
        ii = _at(i, i)
        for t in range(TILE):
            whole = a[ii, t]
            pivot = whole
            for k in range(i):
                pivot -= a[_at(i, k), t] * a[_at(i, k), t]
            lost = not pivot > SMALLEST_PIVOT * whole
            bad[t] = bad[t] or lost
            a[ii, t] = 1.0 if lost else 1.0 / math.sqrt(pivot)


@_jit
def _invert(a):  # type: ignore[no-untyped-def]
    """a = L^-1 in place, then L^-T L^-1: the inverse of the matrix that `_cholesky` took apart."""
    sums = np.empty(TILE)
    for j in range(16):
        for i in range(j + 1, 16):
            sums[:] = 0.0
            for k in range(j, i):
                ik, kj = _at(i, k), _at(k, j)
                for t in range(TILE):
                    sums[t] -= a[ik, t] * a[kj, t]
            ij, ii = _at(i, j), _at(i, i)
            for t in range(TILE):
                a[ij, t] = sums[t] * a[ii, t]
    for i in range(16):
        for j in range(i + 1):
            sums[:] = 0.0
            for k in range(i, 16):
                ki, kj = _at(k, i), _at(k, j)
                for t in range(TILE):
                    sums[t] += a[ki, t] * a[kj, t]
            ij = _at(i, j)
            for t in range(TILE):
                a[ij, t] = sums[t]


@_jit
def _take_tile(normal, a, first, count):  # type: ignore[no-untyped-def]
    """Copy the normal matrices of `count` pixels into a tile; the rest of it holds a matrix that is not singular."""
    for p in range(PACKED):
        for t in range(count):
            a[p, t] = normal[p, first + t]
        for t in range(count, TILE):
            a[p, t] = 1.0
    for i in range(16):
        for t in range(count, TILE):
            a[_at(i, i), t] = 100.0


@in_parts
def _solve_at_once(normal: Array, right: Array, solution: Array, covariance: Array, part: slice) -> None:
    row, column = np.tril_indices(ELEMENTS)
    full = np.empty((normal[:, part].shape[1], ELEMENTS, ELEMENTS))
    full[:, row, column] = full[:, column, row] = normal[:, part].T
    bad = _is_singular(full)
    full[bad] = np.eye(ELEMENTS)
    inverse = np.linalg.inv(full)
    inverse[bad] = np.nan
    solution[:, part] = np.einsum("pij,jp->ip", inverse, right[:, part])
    covariance[:, part] = inverse[:, row, column].T


def _is_singular(full: Array) -> NDArray[np.bool_]:
    """Where Cholesky's method meets a pivot that vanishes."""
    lower, bad = np.zeros_like(full), np.zeros(len(full), bool)
    for i in range(ELEMENTS):
        rest = full[:, i:, i] - np.einsum("pkj,pj->pk", lower[:, i:, :i], lower[:, i, :i])
        lost = ~(rest[:, 0] > SMALLEST_PIVOT * full[:, i, i])
        bad |= lost
        lower[:, i:, i] = rest / np.sqrt(np.where(lost, 1.0, rest[:, 0]))[:, None]
        lower[lost, i, i] = 1.0
    return bad


@compiled(_solve_at_once, **_EXACT)
def solve_range(normal, right, solution, covariance, start, stop):  # type: ignore[no-untyped-def]
    """Solve normal . solution = right for pixels start..stop; covariance = inverse of normal, packed.

    normal, covariance (136, pixels), right, solution (16, pixels), all float32. NaN where a pixel is singular.
    """
    a = np.empty((PACKED, TILE))
    bad = np.zeros(TILE, dtype=np.bool_)
    total = np.empty(TILE)
    for first in range(start, stop, TILE):
        count = min(TILE, stop - first)
        bad[:] = False
        _take_tile(normal, a, first, count)
        _cholesky(a, bad)
        _invert(a)
        for i in range(16):
            total[:] = 0.0
            for k in range(16):
                ik = _at(i, k) if i >= k else _at(k, i)
                for t in range(count):
                    total[t] += a[ik, t] * right[k, first + t]
            for t in range(count):
                solution[i, first + t] = np.nan if bad[t] else total[t]
        for p in range(PACKED):
            for t in range(count):
                covariance[p, first + t] = np.nan if bad[t] else a[p, t]
