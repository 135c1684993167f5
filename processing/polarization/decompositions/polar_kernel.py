"""Loop of the Lu-Chipman decomposition, behind `processing.polarization.decompositions.lu_chipman`.

Tiles as in `polarization.coherency_kernels`: rows of T pixels, so that every inner loop becomes vector instructions.
The rotation is the orthogonal polar factor of the 3 x 3 remainder, by Newton's iteration X <- (X + X^-T) / 2 with
Frobenius scaling (Higham, Functions of Matrices, Sec. 8.6); it needs no eigenvectors and takes both signs of det.
"""

import math

import numpy as np

from processing.arrays import Array, RealArray
from processing.computing.compiling import compiled, in_parts
from processing.polarization.coherency_jacobi import EXACT, T, jit

STEPS = 14
#: det m' relative to |m'|^3 below this is rounding: the rotation is then not determined.
SMALLEST_DETERMINANT = 1e-12


@in_parts
def _at_once(
    planar: RealArray, depolarizer: RealArray, retarder: RealArray, diattenuator: RealArray, sign: Array, part: slice
) -> None:
    m = planar[:, part].T.reshape(-1, 4, 4).astype(float)
    one, three = np.eye(4), np.eye(3)
    with np.errstate(all="ignore"):
        m00 = np.where(m[:, 0, 0] > 0, m[:, 0, 0], np.nan)[:, None, None]
        m /= m00
        d, p = m[:, :1, 1:], m[:, 1:, :1]
        outer, square = np.swapaxes(d, 1, 2) @ d, (d @ np.swapaxes(d, 1, 2))
        q = np.sqrt(np.where(square < 1, 1 - square, np.nan))
        x = (m[:, 1:, 1:] - p @ d) @ (three + outer / (q + q * q)) / q
        r, relative = _polar_factors(np.moveaxis(x, 0, -1))
        turn = np.where(np.abs(relative) > SMALLEST_DETERMINANT, np.sign(relative), np.nan)[:, None, None]
        r = turn * np.moveaxis(r, -1, 0)
        block = x @ np.swapaxes(r, 1, 2)
        parts = np.empty((3, len(m), 4, 4))
        parts[:] = one + 0 * turn
        parts[0, :, 1:, :1] = (p - m[:, 1:, 1:] @ np.swapaxes(d, 1, 2)) / (q * q) + 0 * turn
        parts[0, :, 1:, 1:] = (block + np.swapaxes(block, 1, 2)) / 2
        parts[1, :, 1:, 1:] = r
        parts[2] = m00 * (1 + 0 * q)
        parts[2, :, :1, 1:] *= d
        parts[2, :, 1:, :1] *= np.swapaxes(d, 1, 2)
        parts[2, :, 1:, 1:] *= q * three + outer / (1 + q)
    for out, factor in zip((depolarizer, retarder, diattenuator), parts, strict=True):
        out[:, part] = factor.reshape(-1, 16).T
    sign[part] = turn[:, 0, 0]


def _polar_factors(x: Array) -> tuple[Array, Array]:
    """Orthogonal polar factors of matrices x (3, 3, pixels), and det x / |x|^3 (pixels,)."""
    after, last, relative = [1, 2, 0], [2, 0, 1], None
    x = np.ascontiguousarray(x)
    for _ in range(STEPS):
        y, z = x[after], x[last]
        cofactors = y[:, after] * z[:, last] - y[:, last] * z[:, after]
        det, norm = (x[0] * cofactors[0]).sum(axis=0), np.square(x).sum(axis=(0, 1))
        relative = det / norm**1.5 if relative is None else relative
        inverse = np.square(cofactors).sum(axis=(0, 1)) / det**2
        g = np.sqrt(np.sqrt(inverse / norm))
        x = 0.5 * g * x + 0.5 / (det * g) * cofactors
        if not (norm + inverse > 6 + 1e-14).any():
            break
    return x, np.asarray(relative)


@compiled(_at_once, **EXACT)
def lu_chipman_range(m, depolarizer, retarder, diattenuator, sign, start, stop):  # type: ignore[no-untyped-def]
    """Planar factors (16, pixels) of planar m (16, pixels); sign (pixels,) is that of det m', NaN where undefined."""
    one, x, r, state = np.empty(16 * T), np.empty(9 * T), np.empty(9 * T), np.empty(T)
    for first in range(start, stop, T):
        count = min(T, stop - first)
        for k in range(16):
            row = m[k, first : first + count]
            for j in range(count):
                one[k * T + j] = row[j]
        top = one[: 4 * T].copy()
        _strip_diattenuation(one, count, x, state)
        _rotation(x, r, count, state)
        _depolarizer(one, x, r, count, state)
        _store(one, count, depolarizer, first)
        _retarder(one, r, count, state)
        _store(one, count, retarder, first)
        _diattenuator(top, one, count)
        _store(one, count, diattenuator, first)
        row = sign[first : first + count]
        for j in range(count):
            row[j] = state[j]


@jit
def _store(one, count, out, first):  # type: ignore[no-untyped-def]
    for k in range(16):
        row = out[k, first : first + count]
        for j in range(count):
            row[j] = one[k * T + j]


@jit
def _strip_diattenuation(one, count, x, state):  # type: ignore[no-untyped-def]
    """x = m', the 3 x 3 remainder of M MD^-1 / m00; state = det m' / |m'|^3, NaN where |D| >= 1."""
    for j in range(count):
        m00 = one[j] if one[j] > 0 else np.nan
        u = 1 / m00
        a, b, c = u * one[T + j], u * one[2 * T + j], u * one[3 * T + j]
        square = a * a + b * b + c * c
        rest = 1 - square if square < 1 else np.nan
        q = math.sqrt(rest)
        w, g = 1 / (1 + q), 1 / rest
        e = u * g * q
        p0, p1, p2 = u * one[4 * T + j], u * one[8 * T + j], u * one[12 * T + j]
        d0 = g * (w * u * (one[5 * T + j] * a + one[6 * T + j] * b + one[7 * T + j] * c) - p0)
        d1 = g * (w * u * (one[9 * T + j] * a + one[10 * T + j] * b + one[11 * T + j] * c) - p1)
        d2 = g * (w * u * (one[13 * T + j] * a + one[14 * T + j] * b + one[15 * T + j] * c) - p2)
        x0, x1, x2 = e * one[5 * T + j] + d0 * a, e * one[6 * T + j] + d0 * b, e * one[7 * T + j] + d0 * c
        x3, x4, x5 = e * one[9 * T + j] + d1 * a, e * one[10 * T + j] + d1 * b, e * one[11 * T + j] + d1 * c
        x6, x7, x8 = e * one[13 * T + j] + d2 * a, e * one[14 * T + j] + d2 * b, e * one[15 * T + j] + d2 * c
        x[j], x[T + j], x[2 * T + j] = x0, x1, x2
        x[3 * T + j], x[4 * T + j], x[5 * T + j] = x3, x4, x5
        x[6 * T + j], x[7 * T + j], x[8 * T + j] = x6, x7, x8
        norm = x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3 + x4 * x4 + x5 * x5 + x6 * x6 + x7 * x7 + x8 * x8
        det = x0 * (x4 * x8 - x5 * x7) + x1 * (x5 * x6 - x3 * x8) + x2 * (x3 * x7 - x4 * x6)
        relative = det / (norm * math.sqrt(norm))
        state[j] = relative if abs(relative) > SMALLEST_DETERMINANT else np.nan


@jit
def _rotation(x, r, count, state):  # type: ignore[no-untyped-def]
    """r = orthogonal polar factor of x times the sign of det x: a rotation."""
    for j in range(9 * T):
        r[j] = x[j]
    for _ in range(STEPS):
        moving = 0
        for j in range(count):
            x0, x1, x2 = r[j], r[T + j], r[2 * T + j]
            x3, x4, x5 = r[3 * T + j], r[4 * T + j], r[5 * T + j]
            x6, x7, x8 = r[6 * T + j], r[7 * T + j], r[8 * T + j]
            c0, c1, c2 = x4 * x8 - x5 * x7, x5 * x6 - x3 * x8, x3 * x7 - x4 * x6
            c3, c4, c5 = x2 * x7 - x1 * x8, x0 * x8 - x2 * x6, x1 * x6 - x0 * x7
            c6, c7, c8 = x1 * x5 - x2 * x4, x2 * x3 - x0 * x5, x0 * x4 - x1 * x3
            u = 1 / (x0 * c0 + x1 * c1 + x2 * c2)
            norm = x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3 + x4 * x4 + x5 * x5 + x6 * x6 + x7 * x7 + x8 * x8
            inverse = c0 * c0 + c1 * c1 + c2 * c2 + c3 * c3 + c4 * c4 + c5 * c5 + c6 * c6 + c7 * c7 + c8 * c8
            inverse *= u * u
            g = math.sqrt(math.sqrt(inverse / norm))
            s, t = 0.5 * g, 0.5 * u / g
            r[j], r[T + j], r[2 * T + j] = s * x0 + t * c0, s * x1 + t * c1, s * x2 + t * c2
            r[3 * T + j], r[4 * T + j], r[5 * T + j] = s * x3 + t * c3, s * x4 + t * c4, s * x5 + t * c5
            r[6 * T + j], r[7 * T + j], r[8 * T + j] = s * x6 + t * c6, s * x7 + t * c7, s * x8 + t * c8
            # X is orthogonal where |X|^2 = |X^-1|^2 = 3; the error after this step is the square of the one before.
            moving += 1 if norm + inverse > 6 + 1e-14 else 0
        if moving == 0:
            break
    for j in range(count):
        turn = 1.0 if state[j] > 0 else (-1.0 if state[j] < 0 else np.nan)
        state[j] = turn
        for k in range(9):
            r[k * T + j] *= turn


@jit
def _depolarizer(one, x, r, count, state):  # type: ignore[no-untyped-def]
    """Replace M in `one` by Mdelta = [[1, 0], [(P - m D) / (1 - D^2), x r^T]]."""
    for j in range(count):
        u = 1 / one[j]
        a, b, c = u * one[T + j], u * one[2 * T + j], u * one[3 * T + j]
        g = u / (1 - a * a - b * b - c * c)
        p0 = g * (one[4 * T + j] - one[5 * T + j] * a - one[6 * T + j] * b - one[7 * T + j] * c)
        p1 = g * (one[8 * T + j] - one[9 * T + j] * a - one[10 * T + j] * b - one[11 * T + j] * c)
        p2 = g * (one[12 * T + j] - one[13 * T + j] * a - one[14 * T + j] * b - one[15 * T + j] * c)
        x0, x1, x2, x3, x4, x5 = x[j], x[T + j], x[2 * T + j], x[3 * T + j], x[4 * T + j], x[5 * T + j]
        x6, x7, x8 = x[6 * T + j], x[7 * T + j], x[8 * T + j]
        r0, r1, r2, r3, r4, r5 = r[j], r[T + j], r[2 * T + j], r[3 * T + j], r[4 * T + j], r[5 * T + j]
        r6, r7, r8 = r[6 * T + j], r[7 * T + j], r[8 * T + j]
        zero = 0.0 * state[j]
        one[j], one[T + j], one[2 * T + j], one[3 * T + j] = 1.0 + zero, zero, zero, zero
        one[4 * T + j], one[8 * T + j], one[12 * T + j] = p0 + zero, p1 + zero, p2 + zero
        one[5 * T + j] = x0 * r0 + x1 * r1 + x2 * r2
        one[10 * T + j] = x3 * r3 + x4 * r4 + x5 * r5
        one[15 * T + j] = x6 * r6 + x7 * r7 + x8 * r8
        # Symmetric up to rounding: the mean of both triangles.
        s = 0.5 * (x0 * r3 + x1 * r4 + x2 * r5 + x3 * r0 + x4 * r1 + x5 * r2)
        one[6 * T + j], one[9 * T + j] = s, s
        s = 0.5 * (x0 * r6 + x1 * r7 + x2 * r8 + x6 * r0 + x7 * r1 + x8 * r2)
        one[7 * T + j], one[13 * T + j] = s, s
        s = 0.5 * (x3 * r6 + x4 * r7 + x5 * r8 + x6 * r3 + x7 * r4 + x8 * r5)
        one[11 * T + j], one[14 * T + j] = s, s


@jit
def _retarder(one, r, count, state):  # type: ignore[no-untyped-def]
    for j in range(count):
        zero = 0.0 * state[j]
        one[j], one[T + j], one[2 * T + j], one[3 * T + j] = 1.0 + zero, zero, zero, zero
        one[4 * T + j], one[8 * T + j], one[12 * T + j] = zero, zero, zero
        one[5 * T + j], one[6 * T + j], one[7 * T + j] = r[j], r[T + j], r[2 * T + j]
        one[9 * T + j], one[10 * T + j], one[11 * T + j] = r[3 * T + j], r[4 * T + j], r[5 * T + j]
        one[13 * T + j], one[14 * T + j], one[15 * T + j] = r[6 * T + j], r[7 * T + j], r[8 * T + j]


@jit
def _diattenuator(top, one, count):  # type: ignore[no-untyped-def]
    """MD in `one` from the first row of M."""
    for j in range(count):
        n = top[j] if top[j] > 0 else np.nan
        u = 1 / n
        a, b, c = u * top[T + j], u * top[2 * T + j], u * top[3 * T + j]
        square = a * a + b * b + c * c
        q = math.sqrt(1 - square if square < 1 else np.nan)
        n += 0.0 * q
        w = n / (1 + q)
        one[j], one[T + j], one[2 * T + j], one[3 * T + j] = n, n * a, n * b, n * c
        one[4 * T + j], one[8 * T + j], one[12 * T + j] = n * a, n * b, n * c
        one[5 * T + j], one[6 * T + j], one[7 * T + j] = n * q + w * a * a, w * a * b, w * a * c
        one[9 * T + j], one[10 * T + j], one[11 * T + j] = w * a * b, n * q + w * b * b, w * b * c
        one[13 * T + j], one[14 * T + j], one[15 * T + j] = w * a * c, w * b * c, n * q + w * c * c
