"""Compiled Jacobi rotations over tiles of Hermitian 4 x 4 matrices, behind `processing.polarization.coherency_kernels`.

The layout of a tile is described there. Rows of a tile are passed as slices, so that the compiler sees few pointers
and vectorizes along pixels.
"""

import math
from typing import Any

import numpy as np

from processing.computing.compiling import compiled

T = 256  # pixels in a tile
SWEEPS = 8
OFF_DIAGONAL = 1e-31  # sum of squares left, in units where tr A^2 = 1

#: Options of `compiled`.
EXACT: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}
jit = compiled(**EXACT)


@jit
def jacobi_tile(a, count, v, vectors):  # type: ignore[no-untyped-def]
    """Diagonalize the tile in place by cyclic Jacobi rotations.

    Rows 0..3 of a end as the eigenvalues, unordered. Where `vectors`, v gets 32 rows: real and imaginary parts of the
    components of eigenvector 0 (rows 0..7), of eigenvector 1, ...
    """
    turn = np.empty(6 * T)
    if vectors:
        v[:] = 0.0
        for k in range(4):
            v[10 * k * T : (10 * k + 1) * T] = 1.0
    for _ in range(SWEEPS):
        if not _off_diagonal(a, count):
            break
        for k in range(3):
            for n in range(k + 1, 4):
                row = _row(k, n)
                _angles(a[k * T : (k + 1) * T], a[n * T : (n + 1) * T], a[row * T : (row + 2) * T], turn, count)
                for r in range(4):
                    if r not in (k, n):
                        # Only r < c is stored; the other triangle is its conjugate.
                        rk, rn = _row(min(r, k), max(r, k)), _row(min(r, n), max(r, n))
                        sk, sn = 1.0 if r < k else -1.0, 1.0 if r < n else -1.0
                        _turn(a[rk * T : (rk + 2) * T], a[rn * T : (rn + 2) * T], sk, sn, turn, count)
                    if vectors:
                        x, y = 8 * k + 2 * r, 8 * n + 2 * r
                        _turn(v[x * T : (x + 2) * T], v[y * T : (y + 2) * T], 1.0, 1.0, turn, count)


@jit
def _row(k, n):  # type: ignore[no-untyped-def]
    """Row of the real part of element k, n (k < n) in a tile."""
    return 2 * (n + k + (1 if k > 0 else 0)) + 2


@jit
def _off_diagonal(a, count):  # type: ignore[no-untyped-def]
    """Number of pixels that still have an off-diagonal element."""
    pending = 0
    for j in range(count):
        off = a[4 * T + j] * a[4 * T + j] + a[5 * T + j] * a[5 * T + j]
        off += a[6 * T + j] * a[6 * T + j] + a[7 * T + j] * a[7 * T + j]
        off += a[8 * T + j] * a[8 * T + j] + a[9 * T + j] * a[9 * T + j]
        off += a[10 * T + j] * a[10 * T + j] + a[11 * T + j] * a[11 * T + j]
        off += a[12 * T + j] * a[12 * T + j] + a[13 * T + j] * a[13 * T + j]
        off += a[14 * T + j] * a[14 * T + j] + a[15 * T + j] * a[15 * T + j]
        pending += 1 if off > OFF_DIAGONAL else 0
    return pending


@jit
def _angles(kk, nn, kn, turn, count):  # type: ignore[no-untyped-def]
    """The rotation that zeroes element kn: rows cos, sin, and both times the phase that makes kn real."""
    for j in range(count):
        re, im = kn[j], kn[T + j]
        square = re * re + im * im
        there = square > 1e-290
        size = math.sqrt(square) if there else 0.0
        inverse = 1 / size if there else 0.0
        delta = nn[j] - kk[j]
        t = 2 * size / (abs(delta) + math.sqrt(delta * delta + 4 * square) + 1e-300)
        t = -t if delta < 0 else t
        c = 1 / math.sqrt(1 + t * t)
        e_re, e_im = re * inverse if there else 1.0, -im * inverse
        turn[j], turn[T + j] = c, t * c
        turn[2 * T + j], turn[3 * T + j] = c * e_re, c * e_im
        turn[4 * T + j], turn[5 * T + j] = t * c * e_re, t * c * e_im
        kk[j] -= t * size
        nn[j] += t * size
        kn[j], kn[T + j] = 0.0, 0.0


@jit
def _turn(p, q, sp, sq, turn, count):  # type: ignore[no-untyped-def]
    """Rotate two columns: p, q hold real and imaginary parts, the latter with signs sp, sq."""
    for j in range(count):
        x, y, z, w = p[j], sp * p[T + j], q[j], sq * q[T + j]
        c, s = turn[j], turn[T + j]
        c_re, c_im, s_re, s_im = turn[2 * T + j], turn[3 * T + j], turn[4 * T + j], turn[5 * T + j]
        p[j], p[T + j] = c * x - s_re * z + s_im * w, sp * (c * y - s_re * w - s_im * z)
        q[j], q[T + j] = s * x + c_re * z - c_im * w, sq * (s * y + c_re * w + c_im * z)


@jit
def project(v, n, j, norm, out, p):  # type: ignore[no-untyped-def]
    """Write the Mueller-Jones matrix (m00 = 1) of eigenvector n of pixel j into out[:, p]; NaN where norm is 0."""
    at = 8 * n * T + j
    j0, j1 = complex(v[at], v[at + T]), complex(v[at + 2 * T], v[at + 3 * T])
    j2, j3 = complex(v[at + 4 * T], v[at + 5 * T]), complex(v[at + 6 * T], v[at + 7 * T])
    g0, g1 = j0.real**2 + j0.imag**2, j1.real**2 + j1.imag**2
    g2, g3 = j2.real**2 + j2.imag**2, j3.real**2 + j3.imag**2
    b01, b23 = j0 * j1.conjugate(), j2 * j3.conjugate()
    b02, b13 = j0 * j2.conjugate(), j1 * j3.conjugate()
    b03, b12 = j0 * j3.conjugate(), j1 * j2.conjugate()
    u = 1 / (g0 + g1 + g2 + g3) if norm > 0 else np.nan
    out[0, p], out[1, p] = u * (g0 + g1 + g2 + g3), u * (g0 - g1 + g2 - g3)
    out[2, p], out[3, p] = 2 * u * (b01 + b23).real, -2 * u * (b01 + b23).imag
    out[4, p], out[5, p] = u * (g0 + g1 - g2 - g3), u * (g0 - g1 - g2 + g3)
    out[6, p], out[7, p] = 2 * u * (b01 - b23).real, -2 * u * (b01 - b23).imag
    out[8, p], out[9, p] = 2 * u * (b02 + b13).real, 2 * u * (b02 - b13).real
    out[10, p], out[11, p] = 2 * u * (b03 + b12).real, 2 * u * (b12 - b03).imag
    out[12, p], out[13, p] = 2 * u * (b02 + b13).imag, 2 * u * (b02 - b13).imag
    out[14, p], out[15, p] = 2 * u * (b03 + b12).imag, 2 * u * (b03 - b12).real
