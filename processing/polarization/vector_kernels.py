"""Loops over pixels behind `vector_noise`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.compiling import compiled, in_parts

#: Pixels that a loop takes at a time, so that its numbers stay in the cache.
_RUN = 512

FAST: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"}}


@in_parts
def _elements_at_once(m: Array, numbers: NDArray[np.int64], covariance: Array, out: Array, part: slice) -> None:
    m, covariance = m[:, part].T.astype(float), np.moveaxis(covariance[..., part], -1, 0).astype(float)
    v = m[:, numbers] / m[:, :1]
    by = covariance[:, 0, numbers] - v * covariance[:, 0, :1] / 2
    c = covariance[:, numbers[:, None], numbers] - v[:, None] * by[..., None] - v[..., None] * by[:, None]
    _moments_at_once(c / m[:, :1, None] ** 2, v, out[:, part])


@in_parts
def _slopes_at_once(vector: Array, by_element: Array, covariance: Array, out: Array, part: slice) -> None:
    by, covariance = (np.moveaxis(each[..., part].astype(float), -1, 0) for each in (by_element, covariance))
    _moments_at_once(by @ covariance @ np.swapaxes(by, 1, 2), vector[:, part].T.astype(float), out[:, part])


def _moments_at_once(c: Array, v: Array, out: Array) -> None:
    n = len(v.T)
    with np.errstate(all="ignore"):
        total, square, size = np.trace(c, axis1=1, axis2=2), np.einsum("pij,pij->p", c, c), np.einsum("pi,pi->p", v, v)
        by = np.einsum("pij,pj->pi", c, v)
        along = np.einsum("pi,pi->p", by, v) / size
        by -= along[:, None] * v
        turned = np.einsum("pi,pi->p", by, by)
        moved = np.einsum("pij,pj->pi", c, by)
        across = np.where(turned > 0, np.einsum("pi,pi->p", by, moved) / turned, 0.0)
        moved -= across[:, None] * by + (turned / size)[:, None] * v
        further = np.where(turned > 0, np.einsum("pi,pi->p", moved, moved) / turned, 0.0)
        out[:6] = along, total, square, turned / size, across, further
    packed = [(i + apart, i) for apart in range(3) for i in range(3 - apart)]
    out[6:] = [c[:, i, j] if i < n else np.full(len(c), np.nan) for i, j in packed]


@compiled(_elements_at_once, **FAST)
def elements(m, numbers, covariance, out, start, stop):  # type: ignore[no-untyped-def]
    """`VectorNoise` (12, pixels) of elements over m00, of m (16, pixels) with covariance (16, 16, pixels)."""
    n = len(numbers)
    c, v, by = np.empty((n, n, _RUN), np.float32), np.empty((n, _RUN), np.float32), np.empty((n, _RUN), np.float32)
    scale, moved = np.empty(_RUN, np.float32), np.empty((n, _RUN), np.float32)
    sums = np.empty((4, _RUN), np.float32)
    for first in range(start, stop, _RUN):
        count = min(_RUN, stop - first)
        for p in range(count):
            scale[p] = 1 / m[0, first + p]
        for i in range(n):
            a = numbers[i]
            for p in range(count):
                v[i, p] = m[a, first + p] * scale[p]
                # Of m_i - v_i m00 / 2: with it the noise of m00 is two products.
                by[i, p] = covariance[0, a, first + p] - np.float32(0.5) * v[i, p] * covariance[0, 0, first + p]
        for p in range(count):
            scale[p] *= scale[p]
        for i in range(n):
            for j in range(i + 1):
                a, b = numbers[i], numbers[j]
                for p in range(count):
                    c[i, j, p] = (covariance[a, b, first + p] - v[j, p] * by[i, p] - v[i, p] * by[j, p]) * scale[p]
        _moments(c, v, by, moved, sums, out, first, count)


@compiled(_slopes_at_once, **FAST)
def slopes(vector, by_element, covariance, out, start, stop):  # type: ignore[no-untyped-def]
    """The same of a vector (n, pixels) with its gradient (n, 16, pixels)."""
    n = len(by_element)
    c, v, by = np.empty((n, n, _RUN), np.float32), np.empty((n, _RUN), np.float32), np.empty((n, _RUN), np.float32)
    moved, sums = np.empty((n, _RUN), np.float32), np.empty((4, _RUN), np.float32)
    of_element = moved[0]
    for first in range(start, stop, _RUN):
        count = min(_RUN, stop - first)
        for i in range(n):
            for p in range(count):
                v[i, p] = vector[i, first + p]
            for j in range(i + 1):
                c[i, j] = 0
            for k in range(16):
                of_element[:] = 0
                for a in range(16):
                    pair = covariance[k, a, first : first + count], by_element[i, a, first : first + count]
                    _add_product(of_element, *pair)
                for j in range(i + 1):
                    _add_product(c[i, j], of_element, by_element[j, k, first : first + count])
        _moments(c, v, by, moved, sums, out, first, count)


@compiled(**FAST)
def _add_product(total, a, b):  # type: ignore[no-untyped-def]
    for p in range(len(b)):
        total[p] += a[p] * b[p]


@compiled(**FAST)
def _add_row(row, v, by, i, total, square):  # type: ignore[no-untyped-def]
    """Add up tr C and tr C^2, and put C v into `by`: a row i of the lower half of C."""
    for p in range(len(total)):
        total[p] += row[i, p]
        square[p] += row[i, p] * row[i, p]
    for j in range(i):
        for p in range(len(total)):
            square[p] += 2 * row[j, p] * row[j, p]
    _apply_row(row, v, by, i, len(total))


@compiled(**FAST)
def _apply_row(row, v, by, i, count):  # type: ignore[no-untyped-def]
    for p in range(count):
        by[i, p] = row[i, p] * v[i, p]
    for j in range(i):
        for p in range(count):
            by[i, p] += row[j, p] * v[j, p]
            by[j, p] += row[j, p] * v[i, p]


@compiled(**FAST)
def _turning(c, v, by, moved, sums, out):  # type: ignore[no-untyped-def]
    """`mixed`, `across` and `further`, of the part `by` of C v across v. `sums` are the squares of v and `by`."""
    (size, turned), (mixed, across, further), count = sums, out, len(out[0])
    for i in range(len(c)):
        _apply_row(c[i], by, moved, i, count)
    across[:], further[:] = 0, 0
    for i in range(len(c)):
        _add_product(across, by[i], moved[i, :count])
    for p in range(count):
        mixed[p] = turned[p] / size[p]
        across[p] = across[p] / turned[p] if turned[p] > 0 else np.float32(0)
    for i in range(len(c)):
        for p in range(count):
            moved[i, p] -= across[p] * by[i, p] + mixed[p] * v[i, p]
        _add_product(further, moved[i], moved[i, :count])
    for p in range(count):
        further[p] = further[p] / turned[p] if turned[p] > 0 else np.float32(0)


@compiled(**FAST)
def _moments(c, v, by, moved, sums, out, first, count):  # type: ignore[no-untyped-def]
    """`vector_noise.VectorNoise` of vectors v (n, pixels) and their covariance, the lower half of which is filled.

    Parameters
    ----------
    by, moved, sums : (n, pixels), (n, pixels) and (4, pixels), filled.
    """
    n = len(c)
    sums[:] = 0
    total, square, size, turned = sums
    along = out[0, first : first + count]
    along[:] = 0
    for i in range(n):
        _add_row(c[i], v, by, i, total, square)
    for i in range(n):
        _add_product(along, by[i], v[i, :count])
        _add_product(size, v[i], v[i])
    for p in range(count):
        along[p] /= size[p]
        out[1, first + p], out[2, first + p] = total[p], square[p]
    for i in range(n):
        for p in range(count):
            by[i, p] -= along[p] * v[i, p]
        _add_product(turned, by[i], by[i])
    _turning(c, v, by, moved, sums[2:], out[3:6, first : first + count])
    place = 6
    for apart in range(3):
        for i in range(3 - apart):
            # No slice: the check of its length takes numba 3 s to compile, most of it for a message.
            for p in range(count):
                out[place, first + p] = c[i + apart, i, p] if i + apart < n else np.float32(np.nan)
            place += 1
