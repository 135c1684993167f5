"""Loops over many small coherency matrices, behind `processing.polarization.cloude`.

Pixels are handled in tiles of T, stored element by element (element, pixel), so that every inner loop
runs along pixels and the compiler turns it into vector instructions. All arithmetic is in float64 whatever the
input: the characteristic polynomial of a float32 matrix loses too many digits near equal eigenvalues.

A tile holds the traceless coherency matrix A = H / tr H - 1/4, scaled to tr A^2 = 1, as 16 real rows:
0..3 the diagonal, then real and imaginary parts of A01, A02, A03, A12, A13, A23. Shift and scale keep the relative
precision for strong depolarizers, where H is close to 1/4.
"""

import math

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.compiling import compiled
from processing.polarization.coherency_jacobi import EXACT, T, jacobi_tile, jit, project
from processing.polarization.mueller import coherency, coherency_to_mueller, from_jones

NEWTON_STEPS = 12
# The error after a step is step^2 p''/(2 p'), at most 4e3 step^2 where the slope is not too small: no digit is left.
LAST_STEP = 1e-10
# p'(x0) is the product of the three gaps to the largest root, in units where tr A^2 = 1. Below this Newton
# and the adjugate lose digits (a gap of about 1e-3), and Jacobi takes over.
SMALLEST_SLOPE = 1e-3
# tr A^2 below this is rounding of an ideal depolarizer, which has no dominant process.
SMALLEST_NORM = 1e-24


@jit
def load_tile(m, start, count, a, b, norm):  # type: ignore[no-untyped-def]
    """Fill a from planar m (16, pixels); norm (T,) is the scale, sqrt(tr A^2), NaN where m00 <= 0. b is scratch."""
    for k in range(16):
        row = m[k, start : start + count]
        for j in range(count):
            b[k * T + j] = row[j]
    for j in range(count):
        m00 = b[j]
        u = 0.25 / m00
        rp0, rm0 = m00 + b[4 * T + j], m00 - b[4 * T + j]
        rp1, rm1 = b[1 * T + j] + b[5 * T + j], b[1 * T + j] - b[5 * T + j]
        rp2, rm2 = b[2 * T + j] + b[6 * T + j], b[2 * T + j] - b[6 * T + j]
        rp3, rm3 = b[3 * T + j] + b[7 * T + j], b[3 * T + j] - b[7 * T + j]
        a[j], a[1 * T + j] = u * (rp0 + rp1) - 0.25, u * (rp0 - rp1) - 0.25
        a[2 * T + j], a[3 * T + j] = u * (rm0 + rm1) - 0.25, u * (rm0 - rm1) - 0.25
        a[4 * T + j], a[5 * T + j] = u * rp2, -u * rp3
        a[6 * T + j], a[7 * T + j] = u * (b[8 * T + j] + b[9 * T + j]), u * (b[12 * T + j] + b[13 * T + j])
        a[8 * T + j], a[9 * T + j] = u * (b[10 * T + j] + b[15 * T + j]), u * (b[14 * T + j] - b[11 * T + j])
        a[10 * T + j], a[11 * T + j] = u * (b[10 * T + j] - b[15 * T + j]), u * (b[14 * T + j] + b[11 * T + j])
        a[12 * T + j], a[13 * T + j] = u * (b[8 * T + j] - b[9 * T + j]), u * (b[12 * T + j] - b[13 * T + j])
        a[14 * T + j], a[15 * T + j] = u * rm2, -u * rm3
        norm[j] = 0.0 if m00 > 0 else np.nan
    for j in range(count):
        total = a[j] * a[j] + a[1 * T + j] * a[1 * T + j] + a[2 * T + j] * a[2 * T + j] + a[3 * T + j] * a[3 * T + j]
        off = 0.0
        off += (
            a[4 * T + j] * a[4 * T + j]
            + a[5 * T + j] * a[5 * T + j]
            + a[6 * T + j] * a[6 * T + j]
            + a[7 * T + j] * a[7 * T + j]
        )
        off += (
            a[8 * T + j] * a[8 * T + j]
            + a[9 * T + j] * a[9 * T + j]
            + a[10 * T + j] * a[10 * T + j]
            + a[11 * T + j] * a[11 * T + j]
        )
        off += (
            a[12 * T + j] * a[12 * T + j]
            + a[13 * T + j] * a[13 * T + j]
            + a[14 * T + j] * a[14 * T + j]
            + a[15 * T + j] * a[15 * T + j]
        )
        total += 2 * off
        s = math.sqrt(total) if total > SMALLEST_NORM else 0.0
        norm[j] += s + 0.0 * total
        inverse = 1 / s if total > SMALLEST_NORM else 0.0
        for k in range(16):
            a[k * T + j] *= inverse


@jit
def square_tile(a, count, b):  # type: ignore[no-untyped-def]
    """b = A A, in the same 16 rows."""
    for j in range(count):
        d0, d1, d2, d3 = a[j], a[1 * T + j], a[2 * T + j], a[3 * T + j]
        r01, i01, r02, i02 = a[4 * T + j], a[5 * T + j], a[6 * T + j], a[7 * T + j]
        r03, i03, r12, i12 = a[8 * T + j], a[9 * T + j], a[10 * T + j], a[11 * T + j]
        r13, i13, r23, i23 = a[12 * T + j], a[13 * T + j], a[14 * T + j], a[15 * T + j]
        n01, n02, n03 = r01 * r01 + i01 * i01, r02 * r02 + i02 * i02, r03 * r03 + i03 * i03
        n12, n13, n23 = r12 * r12 + i12 * i12, r13 * r13 + i13 * i13, r23 * r23 + i23 * i23
        b[j], b[1 * T + j] = d0 * d0 + n01 + n02 + n03, d1 * d1 + n01 + n12 + n13
        b[2 * T + j], b[3 * T + j] = d2 * d2 + n02 + n12 + n23, d3 * d3 + n03 + n13 + n23
        b[4 * T + j] = (d0 + d1) * r01 + r02 * r12 + i02 * i12 + r03 * r13 + i03 * i13
        b[5 * T + j] = (d0 + d1) * i01 + i02 * r12 - r02 * i12 + i03 * r13 - r03 * i13
        b[6 * T + j] = (d0 + d2) * r02 + r01 * r12 - i01 * i12 + r03 * r23 + i03 * i23
        b[7 * T + j] = (d0 + d2) * i02 + r01 * i12 + i01 * r12 + i03 * r23 - r03 * i23
        b[8 * T + j] = (d0 + d3) * r03 + r01 * r13 - i01 * i13 + r02 * r23 - i02 * i23
        b[9 * T + j] = (d0 + d3) * i03 + r01 * i13 + i01 * r13 + r02 * i23 + i02 * r23
        b[10 * T + j] = (d1 + d2) * r12 + r01 * r02 + i01 * i02 + r13 * r23 + i13 * i23
        b[11 * T + j] = (d1 + d2) * i12 + r01 * i02 - i01 * r02 + i13 * r23 - r13 * i23
        b[12 * T + j] = (d1 + d3) * r13 + r01 * r03 + i01 * i03 + r12 * r23 - i12 * i23
        b[13 * T + j] = (d1 + d3) * i13 + r01 * i03 - i01 * r03 + r12 * i23 + i12 * r23
        b[14 * T + j] = (d2 + d3) * r23 + r02 * r03 + i02 * i03 + r12 * r13 + i12 * i13
        b[15 * T + j] = (d2 + d3) * i23 + r02 * i03 - i02 * r03 + r12 * i13 - i12 * r13


@jit
def largest_root_tile(a, b, count, x, slope):  # type: ignore[no-untyped-def]
    """Largest root x (T,) of the characteristic polynomial of A from A and B = A A, and the slope there.

    Newton from an upper bound of the largest root; all roots are real, so it descends monotonically. The other three
    sum to -x, so tr A^4 >= x^4 + 3 (x/3)^4: equality, and the root at once, for a triply degenerate matrix.
    A slope of 0 marks a pixel where it did not converge or where the largest roots are too close.
    """
    e3 = np.empty(T)
    e4 = np.empty(T)
    for j in range(count):
        cube = a[j] * b[j] + a[1 * T + j] * b[1 * T + j] + a[2 * T + j] * b[2 * T + j] + a[3 * T + j] * b[3 * T + j]
        fourth = b[j] * b[j] + b[1 * T + j] * b[1 * T + j] + b[2 * T + j] * b[2 * T + j] + b[3 * T + j] * b[3 * T + j]
        for k in range(4, 16):
            cube += 2 * a[k * T + j] * b[k * T + j]
            fourth += 2 * b[k * T + j] * b[k * T + j]
        e3[j] = cube / 3
        e4[j] = (0.5 - fourth) / 4
        x[j] = math.sqrt(math.sqrt(fourth * (27 / 28)))
    for _ in range(NEWTON_STEPS):
        moving = 0
        for j in range(count):
            v = x[j]
            step = (((v * v - 0.5) * v - e3[j]) * v + e4[j]) / ((4 * v * v - 1) * v - e3[j])
            x[j] = v - step
            slope[j] = step
            moving += 1 if abs(step) > LAST_STEP else 0
        if moving == 0:
            break
    for j in range(count):
        v = x[j]
        gaps = (4 * v * v - 1) * v - e3[j]
        slope[j] = gaps if (gaps > SMALLEST_SLOPE and abs(slope[j]) <= LAST_STEP) else 0.0


@jit
def dominant_tile(a, b, x, count, c, out, start):  # type: ignore[no-untyped-def]
    """Write the dominant Mueller-Jones matrix, m00 = 1, into planar out (16, pixels); c is scratch.

    The adjugate of x - A is A^3 + x A^2 + (x^2 + e2) A + const: the dominant projector times the slope.
    """
    for j in range(count):
        v = x[j]
        w = v * v - 0.5
        d0, d1, d2, d3 = a[j], a[1 * T + j], a[2 * T + j], a[3 * T + j]
        r01, i01, r02, i02 = a[4 * T + j], a[5 * T + j], a[6 * T + j], a[7 * T + j]
        r03, i03, r12, i12 = a[8 * T + j], a[9 * T + j], a[10 * T + j], a[11 * T + j]
        r13, i13, r23, i23 = a[12 * T + j], a[13 * T + j], a[14 * T + j], a[15 * T + j]
        c0, c1 = b[j] + v * d0 + w, b[1 * T + j] + v * d1 + w
        c2, c3 = b[2 * T + j] + v * d2 + w, b[3 * T + j] + v * d3 + w
        s01, t01 = b[4 * T + j] + v * r01, b[5 * T + j] + v * i01
        s02, t02 = b[6 * T + j] + v * r02, b[7 * T + j] + v * i02
        s03, t03 = b[8 * T + j] + v * r03, b[9 * T + j] + v * i03
        s12, t12 = b[10 * T + j] + v * r12, b[11 * T + j] + v * i12
        s13, t13 = b[12 * T + j] + v * r13, b[13 * T + j] + v * i13
        s23, t23 = b[14 * T + j] + v * r23, b[15 * T + j] + v * i23
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
        c[j], c[1 * T + j] = 1.0, u * (g0 - g1 + g2 - g3)
        c[2 * T + j], c[3 * T + j] = 2 * u * (p01 + p23), -2 * u * (q01 + q23)
        c[4 * T + j], c[5 * T + j] = u * (g0 + g1 - g2 - g3), u * (g0 - g1 - g2 + g3)
        c[6 * T + j], c[7 * T + j] = 2 * u * (p01 - p23), -2 * u * (q01 - q23)
        c[8 * T + j], c[9 * T + j] = 2 * u * (p02 + p13), 2 * u * (p02 - p13)
        c[10 * T + j], c[11 * T + j] = 2 * u * (p03 + p12), 2 * u * (q12 - q03)
        c[12 * T + j], c[13 * T + j] = 2 * u * (q02 + q13), 2 * u * (q02 - q13)
        c[14 * T + j], c[15 * T + j] = 2 * u * (q03 + q12), 2 * u * (p03 - p12)
    for k in range(16):
        row = out[k, start : start + count]
        for j in range(count):
            row[j] = c[k * T + j]


def _scaled(m: Array, pixels: int) -> tuple[NDArray[np.complex128], Array]:
    """A (pixels, 4, 4) of planar m, and its scale, as `load_tile` has them; zero where the scale is NaN."""
    matrices = m[:, :pixels].T.reshape(-1, 4, 4)
    sound = (matrices[:, 0, 0] > 0) & np.isfinite(matrices).all(axis=(1, 2))
    matrices = np.where(sound[:, None, None], matrices, np.diag([1.0, 0, 0, 0]))
    a = coherency(matrices) / (2 * matrices[:, :1, :1]) - np.eye(4) / 4
    square = np.square(np.abs(a)).sum(axis=(1, 2))
    scale = np.sqrt(np.where(square > SMALLEST_NORM, square, 0.0))
    a /= np.where(scale > 0, scale, np.inf)[:, None, None]
    return a, np.where(sound, scale, np.nan)


def _processes(vectors: NDArray[np.complex128], scale: Array) -> Array:
    """Mueller-Jones matrices (16, pixels) of eigenvectors (pixels, 4)."""
    mueller = from_jones(vectors.reshape(-1, 2, 2)).reshape(-1, 16).T
    return np.where(scale > 0, mueller / mueller[0], np.nan)


def _dominant_at_once(m: Array, pixels: int, xi0: Array, out: Array) -> None:
    a, scale = _scaled(m, pixels)
    b = a @ a
    fourth = np.square(np.abs(b)).sum(axis=(1, 2))
    e3, e4 = np.einsum("pij,pji->p", a, b).real / 3, (0.5 - fourth) / 4
    x = step = np.sqrt(np.sqrt(fourth * (27 / 28)))
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            step = (((x * x - 0.5) * x - e3) * x + e4) / ((4 * x * x - 1) * x - e3)
            x = x - step
            if not (np.abs(step) > LAST_STEP).any():
                break
        slope, square = (4 * x * x - 1) * x - e3, x * x - 0.5
        unsure = ~((slope > SMALLEST_SLOPE) & (np.abs(step) <= LAST_STEP))
        projector = a @ (b + x[:, None, None] * a + square[:, None, None] * np.eye(4))
        shift = x * square - (np.trace(projector, axis1=1, axis2=2).real - x) / 3
        projector += shift[:, None, None] * np.eye(4)
    values, vectors = np.linalg.eigh(a[unsure])
    x[unsure], projector[unsure] = values[:, 3], vectors[..., 3:] @ np.conj(np.swapaxes(vectors[..., 3:], 1, 2))
    xi0[:pixels] = 0.25 + scale * x
    mueller = coherency_to_mueller(projector).reshape(-1, 16).T
    out[:, :pixels] = np.where(scale > 0, mueller / mueller[0], np.nan)


def _eigenvalues_at_once(m: Array, pixels: int, xi: Array) -> None:
    a, scale = _scaled(m, pixels)
    xi[:, :pixels] = 0.25 + scale * np.linalg.eigvalsh(a)[:, ::-1].T


def _eigensystem_at_once(m: Array, pixels: int, xi: Array, out: Array) -> None:
    a, scale = _scaled(m, pixels)
    values, vectors = np.linalg.eigh(a)
    xi[:, :pixels] = 0.25 + scale * values[:, ::-1].T
    out[..., :pixels] = [_processes(vectors[..., k], scale) for k in (3, 2, 1, 0)]


@compiled(_dominant_at_once, **EXACT)
def dominant(m, pixels, xi0, out):  # type: ignore[no-untyped-def]
    """Largest eigenvalue (pixels,) and dominant Mueller-Jones matrix (16, pixels) of planar m (16, at least pixels)."""
    a, b, c, v = np.empty(16 * T), np.empty(16 * T), np.empty(16 * T), np.empty(32 * T)
    x, slope, norm = np.empty(T), np.empty(T), np.empty(T)
    for first in range(0, pixels, T):
        count = min(T, pixels - first)
        load_tile(m, first, count, a, b, norm)
        square_tile(a, count, b)
        largest_root_tile(a, b, count, x, slope)
        dominant_tile(a, b, x, count, c, out, first)
        doubtful = 0
        for j in range(count):
            xi0[first + j] = 0.25 + norm[j] * x[j]
            slope[j] = slope[j] if norm[j] > 0 else 0.0
            doubtful += 0 if slope[j] > 0 else 1
        if doubtful:
            jacobi_tile(a, count, v, True)
            for j in range(count):
                if not slope[j] > 0:
                    best = 0
                    for k in range(1, 4):
                        best = k if a[k * T + j] > a[best * T + j] else best
                    xi0[first + j] = 0.25 + norm[j] * a[best * T + j]
                    project(v, best, j, norm[j], out, first + j)


@compiled(_eigenvalues_at_once, **EXACT)
def eigenvalues(m, pixels, xi):  # type: ignore[no-untyped-def]
    """All eigenvalues, descending, into xi (4, pixels)."""
    a, b, norm = np.empty(16 * T), np.empty(16 * T), np.empty(T)
    for first in range(0, pixels, T):
        count = min(T, pixels - first)
        load_tile(m, first, count, a, b, norm)
        jacobi_tile(a, count, b, False)
        for j in range(count):
            for k in range(4):
                value = 0.25 + norm[j] * a[k * T + j]
                at = k
                while at > 0 and xi[at - 1, first + j] < value:
                    xi[at, first + j] = xi[at - 1, first + j]
                    at -= 1
                xi[at, first + j] = value


@compiled(_eigensystem_at_once, **EXACT)
def eigensystem(m, pixels, xi, out):  # type: ignore[no-untyped-def]
    """All eigenvalues, descending, into xi (4, pixels), and their Mueller-Jones matrices into out (4, 16, pixels)."""
    a, b, v = np.empty(16 * T), np.empty(16 * T), np.empty(32 * T)
    norm, order = np.empty(T), np.empty(4, np.int64)
    for first in range(0, pixels, T):
        count = min(T, pixels - first)
        load_tile(m, first, count, a, b, norm)
        jacobi_tile(a, count, v, True)
        for j in range(count):
            for k in range(4):
                at = k
                while at > 0 and a[order[at - 1] * T + j] < a[k * T + j]:
                    order[at] = order[at - 1]
                    at -= 1
                order[at] = k
            for k in range(4):
                xi[k, first + j] = 0.25 + norm[j] * a[order[k] * T + j]
                project(v, order[k], j, norm[j], out[k], first + j)
