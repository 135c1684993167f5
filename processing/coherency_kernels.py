"""Compiled loops over many small coherency matrices, behind `processing.cloude`.

Pixels are handled in tiles of TILE, stored element by element (element, pixel), so that every inner loop
runs along pixels and the compiler turns it into vector instructions. All arithmetic is in float64 whatever the
input: the characteristic polynomial of a float32 matrix loses too many digits near equal eigenvalues.

A tile holds the traceless coherency matrix A = H / tr H - 1/4, scaled to tr A^2 = 1, as 16 real rows:
0..3 the diagonal, then real and imaginary parts of A01, A02, A03, A12, A13, A23. Shift and scale keep the relative
precision for strong depolarizers, where H is close to 1/4.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

TILE = 256
NEWTON_STEPS = 12
# p'(x0) is the product of the three gaps to the largest root, in units where tr A^2 = 1. Below this Newton
# and the adjugate lose digits (a gap of about 1e-3), and Jacobi takes over.
SMALLEST_SLOPE = 1e-3
# tr A^2 below this is rounding of an ideal depolarizer, which has no dominant process.
SMALLEST_NORM = 1e-24

_jit = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})


@_jit
def load_tile(m, start, count, a, norm):  # type: ignore[no-untyped-def]
    """Fill a (16, TILE) and norm (TILE,) from planar m (16, pixels); norm is sqrt(tr A^2) before scaling, NaN if m00 <= 0."""
    for j in range(count):
        p = start + j
        m00 = np.float64(m[0, p])
        u = 0.25 / m00
        rp0, rm0 = m00 + m[4, p], m00 - m[4, p]
        rp1, rm1 = np.float64(m[1, p]) + m[5, p], np.float64(m[1, p]) - m[5, p]
        rp2, rm2 = np.float64(m[2, p]) + m[6, p], np.float64(m[2, p]) - m[6, p]
        rp3, rm3 = np.float64(m[3, p]) + m[7, p], np.float64(m[3, p]) - m[7, p]
        a[0, j], a[1, j] = u * (rp0 + rp1) - 0.25, u * (rp0 - rp1) - 0.25
        a[2, j], a[3, j] = u * (rm0 + rm1) - 0.25, u * (rm0 - rm1) - 0.25
        a[4, j], a[5, j] = u * rp2, -u * rp3
        a[6, j], a[7, j] = u * (np.float64(m[8, p]) + m[9, p]), u * (np.float64(m[12, p]) + m[13, p])
        a[8, j], a[9, j] = u * (np.float64(m[10, p]) + m[15, p]), u * (np.float64(m[14, p]) - m[11, p])
        a[10, j], a[11, j] = u * (np.float64(m[10, p]) - m[15, p]), u * (np.float64(m[14, p]) + m[11, p])
        a[12, j], a[13, j] = u * (np.float64(m[8, p]) - m[9, p]), u * (np.float64(m[12, p]) - m[13, p])
        a[14, j], a[15, j] = u * rm2, -u * rm3
        norm[j] = 0.0 if m00 > 0 else np.nan
    for j in range(count):
        total = a[0, j] * a[0, j] + a[1, j] * a[1, j] + a[2, j] * a[2, j] + a[3, j] * a[3, j]
        off = 0.0
        off += a[4, j] * a[4, j] + a[5, j] * a[5, j] + a[6, j] * a[6, j] + a[7, j] * a[7, j]
        off += a[8, j] * a[8, j] + a[9, j] * a[9, j] + a[10, j] * a[10, j] + a[11, j] * a[11, j]
        off += a[12, j] * a[12, j] + a[13, j] * a[13, j] + a[14, j] * a[14, j] + a[15, j] * a[15, j]
        total += 2 * off
        s = math.sqrt(total) if total > SMALLEST_NORM else 0.0
        norm[j] += s + 0.0 * total
        inverse = 1 / s if total > SMALLEST_NORM else 0.0
        for k in range(16):
            a[k, j] *= inverse


@_jit
def square_tile(a, count, b):  # type: ignore[no-untyped-def]
    """b = A A, in the same 16 rows."""
    for j in range(count):
        d0, d1, d2, d3 = a[0, j], a[1, j], a[2, j], a[3, j]
        r01, i01, r02, i02, r03, i03 = a[4, j], a[5, j], a[6, j], a[7, j], a[8, j], a[9, j]
        r12, i12, r13, i13, r23, i23 = a[10, j], a[11, j], a[12, j], a[13, j], a[14, j], a[15, j]
        n01, n02, n03 = r01 * r01 + i01 * i01, r02 * r02 + i02 * i02, r03 * r03 + i03 * i03
        n12, n13, n23 = r12 * r12 + i12 * i12, r13 * r13 + i13 * i13, r23 * r23 + i23 * i23
        b[0, j], b[1, j] = d0 * d0 + n01 + n02 + n03, d1 * d1 + n01 + n12 + n13
        b[2, j], b[3, j] = d2 * d2 + n02 + n12 + n23, d3 * d3 + n03 + n13 + n23
        b[4, j] = (d0 + d1) * r01 + r02 * r12 + i02 * i12 + r03 * r13 + i03 * i13
        b[5, j] = (d0 + d1) * i01 + i02 * r12 - r02 * i12 + i03 * r13 - r03 * i13
        b[6, j] = (d0 + d2) * r02 + r01 * r12 - i01 * i12 + r03 * r23 + i03 * i23
        b[7, j] = (d0 + d2) * i02 + r01 * i12 + i01 * r12 + i03 * r23 - r03 * i23
        b[8, j] = (d0 + d3) * r03 + r01 * r13 - i01 * i13 + r02 * r23 - i02 * i23
        b[9, j] = (d0 + d3) * i03 + r01 * i13 + i01 * r13 + r02 * i23 + i02 * r23
        b[10, j] = (d1 + d2) * r12 + r01 * r02 + i01 * i02 + r13 * r23 + i13 * i23
        b[11, j] = (d1 + d2) * i12 + r01 * i02 - i01 * r02 + i13 * r23 - r13 * i23
        b[12, j] = (d1 + d3) * r13 + r01 * r03 + i01 * i03 + r12 * r23 - i12 * i23
        b[13, j] = (d1 + d3) * i13 + r01 * i03 - i01 * r03 + r12 * i23 + i12 * r23
        b[14, j] = (d2 + d3) * r23 + r02 * r03 + i02 * i03 + r12 * r13 + i12 * i13
        b[15, j] = (d2 + d3) * i23 + r02 * i03 - i02 * r03 + r12 * i13 - i12 * r13


@_jit
def largest_root_tile(a, b, count, x, slope):  # type: ignore[no-untyped-def]
    """Largest root x (TILE,) of the characteristic polynomial of A from A and B = A A, and the slope there.

    Newton from the upper bound sqrt(3)/2 of the largest root; all roots are real, so it descends monotonically.
    A slope of 0 marks a pixel where it did not converge or where the largest roots are too close.
    """
    e3 = np.empty(TILE)
    e4 = np.empty(TILE)
    for j in range(count):
        cube = a[0, j] * b[0, j] + a[1, j] * b[1, j] + a[2, j] * b[2, j] + a[3, j] * b[3, j]
        fourth = b[0, j] * b[0, j] + b[1, j] * b[1, j] + b[2, j] * b[2, j] + b[3, j] * b[3, j]
        for k in range(4, 16):
            cube += 2 * a[k, j] * b[k, j]
            fourth += 2 * b[k, j] * b[k, j]
        e3[j] = cube / 3
        e4[j] = (0.5 - fourth) / 4
        x[j] = 0.8660254037844387
    for _ in range(NEWTON_STEPS):
        moving = 0
        for j in range(count):
            v = x[j]
            step = (((v * v - 0.5) * v - e3[j]) * v + e4[j]) / ((4 * v * v - 1) * v - e3[j])
            x[j] = v - step
            slope[j] = step
            moving += 1 if abs(step) > 1e-15 else 0
        if moving == 0:
            break
    for j in range(count):
        v = x[j]
        gaps = (4 * v * v - 1) * v - e3[j]
        slope[j] = gaps if (gaps > SMALLEST_SLOPE and abs(slope[j]) < 1e-12) else 0.0


@_jit
def dominant_tile(a, b, x, count, out, start):  # type: ignore[no-untyped-def]
    """Write the dominant Mueller-Jones matrix, m00 = 1, into planar out (16, pixels).

    The adjugate of x - A is A^3 + x A^2 + (x^2 + e2) A + const: the dominant projector times the slope.
    """
    for j in range(count):
        v = x[j]
        w = v * v - 0.5
        d0, d1, d2, d3 = a[0, j], a[1, j], a[2, j], a[3, j]
        r01, i01, r02, i02, r03, i03 = a[4, j], a[5, j], a[6, j], a[7, j], a[8, j], a[9, j]
        r12, i12, r13, i13, r23, i23 = a[10, j], a[11, j], a[12, j], a[13, j], a[14, j], a[15, j]
        c0, c1 = b[0, j] + v * d0 + w, b[1, j] + v * d1 + w
        c2, c3 = b[2, j] + v * d2 + w, b[3, j] + v * d3 + w
        s01, t01 = b[4, j] + v * r01, b[5, j] + v * i01
        s02, t02 = b[6, j] + v * r02, b[7, j] + v * i02
        s03, t03 = b[8, j] + v * r03, b[9, j] + v * i03
        s12, t12 = b[10, j] + v * r12, b[11, j] + v * i12
        s13, t13 = b[12, j] + v * r13, b[13, j] + v * i13
        s23, t23 = b[14, j] + v * r23, b[15, j] + v * i23
        g0 = d0 * c0 + r01 * s01 + i01 * t01 + r02 * s02 + i02 * t02 + r03 * s03 + i03 * t03
        g1 = d1 * c1 + r01 * s01 + i01 * t01 + r12 * s12 + i12 * t12 + r13 * s13 + i13 * t13
        g2 = d2 * c2 + r02 * s02 + i02 * t02 + r12 * s12 + i12 * t12 + r23 * s23 + i23 * t23
        g3 = d3 * c3 + r03 * s03 + i03 * t03 + r13 * s13 + i13 * t13 + r23 * s23 + i23 * t23
        # det(x - A) = 0, so the constant is x (x^2 + e2) - e3 with e3 from tr A C = tr A^3 + x tr A^2 = 3 e3 + x.
        shift = v * w - (g0 + g1 + g2 + g3 - v) / 3
        g0, g1, g2, g3 = g0 + shift, g1 + shift, g2 + shift, g3 + shift
        p01 = d0 * s01 + r01 * c1 + r02 * s12 + i02 * t12 + r03 * s13 + i03 * t13
        q01 = d0 * t01 + i01 * c1 + i02 * s12 - r02 * t12 + i03 * s13 - r03 * t13
        p02 = d0 * s02 + r01 * s12 - i01 * t12 + r02 * c2 + r03 * s23 + i03 * t23
        q02 = d0 * t02 + r01 * t12 + i01 * s12 + i02 * c2 + i03 * s23 - r03 * t23
        p03 = d0 * s03 + r01 * s13 - i01 * t13 + r02 * s23 - i02 * t23 + r03 * c3
        q03 = d0 * t03 + r01 * t13 + i01 * s13 + r02 * t23 + i02 * s23 + i03 * c3
        p12 = d1 * s12 + r01 * s02 + i01 * t02 + r12 * c2 + r13 * s23 + i13 * t23
        q12 = d1 * t12 + r01 * t02 - i01 * s02 + i12 * c2 + i13 * s23 - r13 * t23
        p13 = d1 * s13 + r01 * s03 + i01 * t03 + r12 * s23 - i12 * t23 + r13 * c3
        q13 = d1 * t13 + r01 * t03 - i01 * s03 + r12 * t23 + i12 * s23 + i13 * c3
        p23 = d2 * s23 + r02 * s03 + i02 * t03 + r12 * s13 + i12 * t13 + r23 * c3
        q23 = d2 * t23 + r02 * t03 - i02 * s03 + r12 * t13 - i12 * s13 + i23 * c3
        u = 1 / (g0 + g1 + g2 + g3)
        p = start + j
        out[0, p], out[1, p] = 1.0, u * (g0 - g1 + g2 - g3)
        out[2, p], out[3, p] = 2 * u * (p01 + p23), -2 * u * (q01 + q23)
        out[4, p], out[5, p] = u * (g0 + g1 - g2 - g3), u * (g0 - g1 - g2 + g3)
        out[6, p], out[7, p] = 2 * u * (p01 - p23), -2 * u * (q01 - q23)
        out[8, p], out[9, p] = 2 * u * (p02 + p13), 2 * u * (p02 - p13)
        out[10, p], out[11, p] = 2 * u * (p03 + p12), 2 * u * (q12 - q03)
        out[12, p], out[13, p] = 2 * u * (q02 + q13), 2 * u * (q02 - q13)
        out[14, p], out[15, p] = 2 * u * (q03 + q12), 2 * u * (p03 - p12)


@_jit
def jacobi_tile(a, count, h, g, v, w, vectors):  # type: ignore[no-untyped-def]
    """Diagonalize the tile by cyclic Jacobi rotations.

    h + i g (4, 4, TILE) ends diagonal, v + i w (4, 4, TILE) holds the eigenvectors as columns where `vectors`.
    """
    for k in range(4):
        h[k, k, :count] = a[k, :count]
        g[k, k, :count] = 0.0
    row = 4
    for k in range(3):
        for n in range(k + 1, 4):
            h[k, n, :count] = a[row, :count]
            h[n, k, :count] = a[row, :count]
            g[k, n, :count] = a[row + 1, :count]
            g[n, k, :count] = -a[row + 1, :count]
            row += 2
    if vectors:
        w[:] = 0.0
        v[:] = 0.0
        for k in range(4):
            v[k, k, :] = 1.0
    cosine, s_re, s_im, sine = np.empty(TILE), np.empty(TILE), np.empty(TILE), np.empty(TILE)
    c_re, c_im = np.empty(TILE), np.empty(TILE)
    for _ in range(8):
        moving = 0
        for j in range(count):
            off = h[0, 1, j] ** 2 + g[0, 1, j] ** 2 + h[0, 2, j] ** 2 + g[0, 2, j] ** 2
            off += h[0, 3, j] ** 2 + g[0, 3, j] ** 2 + h[1, 2, j] ** 2 + g[1, 2, j] ** 2
            off += h[1, 3, j] ** 2 + g[1, 3, j] ** 2 + h[2, 3, j] ** 2 + g[2, 3, j] ** 2
            moving += 1 if off > 1e-31 else 0
        if moving == 0:
            break
        for k in range(3):
            for n in range(k + 1, 4):
                for j in range(count):
                    re, im = h[k, n, j], g[k, n, j]
                    square = re * re + im * im
                    there = square > 1e-290
                    size = math.sqrt(square) if there else 0.0
                    inverse = 1 / size if there else 0.0
                    delta = h[n, n, j] - h[k, k, j]
                    bottom = abs(delta) + math.sqrt(delta * delta + 4 * square) + 1e-300
                    t = math.copysign(2 * size / bottom, delta)
                    c = 1 / math.sqrt(1 + t * t)
                    s = t * c
                    # the column n is first turned by the conjugate phase of the element, which makes it real
                    e_re = re * inverse if there else 1.0
                    e_im = -im * inverse if there else 0.0
                    cosine[j], sine[j] = c, s
                    s_re[j], s_im[j] = s * e_re, s * e_im
                    c_re[j], c_im[j] = c * e_re, c * e_im
                    h[k, k, j] -= t * size
                    h[n, n, j] += t * size
                    h[k, n, j], g[k, n, j], h[n, k, j], g[n, k, j] = 0.0, 0.0, 0.0, 0.0
                for r in range(4):
                    if r not in (k, n):
                        for j in range(count):
                            x, y, z, q = h[r, k, j], g[r, k, j], h[r, n, j], g[r, n, j]
                            p_re = cosine[j] * x - s_re[j] * z + s_im[j] * q
                            p_im = cosine[j] * y - s_re[j] * q - s_im[j] * z
                            q_re = sine[j] * x + c_re[j] * z - c_im[j] * q
                            q_im = sine[j] * y + c_re[j] * q + c_im[j] * z
                            h[r, k, j], g[r, k, j], h[k, r, j], g[k, r, j] = p_re, p_im, p_re, -p_im
                            h[r, n, j], g[r, n, j], h[n, r, j], g[n, r, j] = q_re, q_im, q_re, -q_im
                    if vectors:
                        for j in range(count):
                            x, y, z, q = v[r, k, j], w[r, k, j], v[r, n, j], w[r, n, j]
                            v[r, k, j] = cosine[j] * x - s_re[j] * z + s_im[j] * q
                            w[r, k, j] = cosine[j] * y - s_re[j] * q - s_im[j] * z
                            v[r, n, j] = sine[j] * x + c_re[j] * z - c_im[j] * q
                            w[r, n, j] = sine[j] * y + c_re[j] * q + c_im[j] * z


@_jit
def dominant_range(m, xi0, out, start, stop):  # type: ignore[no-untyped-def]
    """Largest eigenvalue and dominant Mueller-Jones matrix of pixels start..stop of planar m (16, pixels)."""
    a, b = np.empty((16, TILE)), np.empty((16, TILE))
    x, slope, norm = np.empty(TILE), np.empty(TILE), np.empty(TILE)
    h, g, v, w = np.empty((4, 4, TILE)), np.empty((4, 4, TILE)), np.empty((4, 4, TILE)), np.empty((4, 4, TILE))
    for first in range(start, stop, TILE):
        count = min(TILE, stop - first)
        load_tile(m, first, count, a, norm)
        square_tile(a, count, b)
        largest_root_tile(a, b, count, x, slope)
        dominant_tile(a, b, x, count, out, first)
        doubtful = 0
        for j in range(count):
            xi0[first + j] = 0.25 + norm[j] * x[j]
            doubtful += 0 if slope[j] > 0 else 1
        if doubtful:
            jacobi_tile(a, count, h, g, v, w, True)
            for j in range(count):
                if not slope[j] > 0:
                    _replace_dominant(h, v, w, j, norm[j], xi0, out, first + j)


@_jit
def _replace_dominant(h, v, w, j, norm, xi0, out, p):  # type: ignore[no-untyped-def]
    best = 0
    for k in range(1, 4):
        if h[k, k, j] > h[best, best, j]:
            best = k
    xi0[p] = 0.25 + norm * h[best, best, j]
    if norm > 0:
        project(v, w, best, j, out, p)
    else:
        for k in range(16):
            out[k, p] = np.nan


@_jit
def project(v, w, n, j, out, p):  # type: ignore[no-untyped-def]
    """Write the Mueller-Jones matrix, m00 = 1, of eigenvector n of pixel j of the tile into out[:, p]."""
    j0, j1 = complex(v[0, n, j], w[0, n, j]), complex(v[1, n, j], w[1, n, j])
    j2, j3 = complex(v[2, n, j], w[2, n, j]), complex(v[3, n, j], w[3, n, j])
    g0, g1 = j0.real**2 + j0.imag**2, j1.real**2 + j1.imag**2
    g2, g3 = j2.real**2 + j2.imag**2, j3.real**2 + j3.imag**2
    b01, b23 = j0 * j1.conjugate(), j2 * j3.conjugate()
    b02, b13 = j0 * j2.conjugate(), j1 * j3.conjugate()
    b03, b12 = j0 * j3.conjugate(), j1 * j2.conjugate()
    u = 1 / (g0 + g1 + g2 + g3)
    out[0, p], out[1, p] = 1.0, u * (g0 - g1 + g2 - g3)
    out[2, p], out[3, p] = 2 * u * (b01 + b23).real, -2 * u * (b01 + b23).imag
    out[4, p], out[5, p] = u * (g0 + g1 - g2 - g3), u * (g0 - g1 - g2 + g3)
    out[6, p], out[7, p] = 2 * u * (b01 - b23).real, -2 * u * (b01 - b23).imag
    out[8, p], out[9, p] = 2 * u * (b02 + b13).real, 2 * u * (b02 - b13).real
    out[10, p], out[11, p] = 2 * u * (b03 + b12).real, 2 * u * (b12 - b03).imag
    out[12, p], out[13, p] = 2 * u * (b02 + b13).imag, 2 * u * (b02 - b13).imag
    out[14, p], out[15, p] = 2 * u * (b03 + b12).imag, 2 * u * (b03 - b12).real


@_jit
def eigen_range(m, xi, out, start, stop):  # type: ignore[no-untyped-def]
    """All eigenvalues, descending, into xi (4, pixels); out (4, 16, pixels), if not empty, gets the four matrices."""
    a, norm, order = np.empty((16, TILE)), np.empty(TILE), np.empty(4, np.int64)
    h, g, v, w = np.empty((4, 4, TILE)), np.empty((4, 4, TILE)), np.empty((4, 4, TILE)), np.empty((4, 4, TILE))
    vectors = out.shape[2] > 0
    for first in range(start, stop, TILE):
        count = min(TILE, stop - first)
        load_tile(m, first, count, a, norm)
        jacobi_tile(a, count, h, g, v, w, vectors)
        for j in range(count):
            for k in range(4):
                at = k
                while at > 0 and h[order[at - 1], order[at - 1], j] < h[k, k, j]:
                    order[at] = order[at - 1]
                    at -= 1
                order[at] = k
            for k in range(4):
                n = order[k]
                xi[k, first + j] = 0.25 + norm[j] * h[n, n, j]
                if vectors:
                    if norm[j] > 0:
                        project(v, w, n, j, out[k], first + j)
                    else:
                        for e in range(16):
                            out[k, e, first + j] = np.nan
