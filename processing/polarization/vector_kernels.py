"""Loops over pixels behind `vector_noise`, `magnitude` and `sorted_eigenvalues`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.compiling import compiled, in_parts

#: Of the 68 and 95 % interval.
DEVIATES = (1.0, 1.959964)
#: Least error of a short length, in units of the noise: a far smaller observed one allows hardly any length.
LEAST = 0.55
#: Newton's method: steps at most, relative error at which it ends; relative change of a variance that is neglected.
_STEPS, _CLOSE, _ALIKE = 6, 3e-3, 0.08
#: Pixels that a loop takes at a time, so that its numbers stay in the cache.
_RUN = 512

_FAST: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"}}


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
        mixed = np.sqrt(turned / size)
        turn = DEVIATES[1] * mixed / np.sqrt(along * size)
        counts = turn * (2 * mixed + turn * total) >= _ALIKE * along
        across = np.where(counts, np.einsum("pi,pij,pj->p", by, c, by, optimize=True) / turned, 0.0)
        out[:3] = along, total, square
        out[3:5] = _reach_at_once(np.sqrt(size), along, mixed, across)
    packed = [(i + apart, i) for apart in range(3) for i in range(3 - apart)]
    out[5:] = [c[:, i, j] if i < n else np.full(len(c), np.nan) for i, j in packed]


def _reach_at_once(length: Array, along: Array, mixed: Array, across: Array) -> tuple[Array, Array]:
    half, centre, z = (along - across) / 2, (along + across) / 2, DEVIATES[1]
    turn = z * mixed / (np.sqrt(along) * length)
    alike = turn * (2 * mixed + turn * across) < _ALIKE * along
    radius = np.hypot(half, mixed)
    first, second = centre + radius, np.maximum(centre - radius, 1e-6 * centre)
    one = length * length * (1 + half / radius) / 2
    ends = [_farthest_at_once(length, first, second, one, length * length - one, side) for side in (1.0, -1.0)]
    short = np.where(length * length > z * z * along, along, np.inf)
    return np.where(alike, short, ends[0]), np.where(alike, along, ends[1])


def _farthest_at_once(length: Array, first: Array, second: Array, one: Array, other: Array, side: float) -> Array:
    z, low, high, t = DEVIATES[1], np.zeros_like(first), 1 / first, np.zeros_like(first)
    white = np.sqrt(one / first + other / second)
    if side > 0:
        high = t = (one / first**2 + other / second**2) / white**3 / (1 / z - 1 / white)
    for _ in range(_STEPS):
        a, b = 1 / (1 + side * t * first), 1 / (1 + side * t * second)
        inverse = 1 / np.sqrt(first * one * a * a + second * other * b * b)
        off = inverse - t / z
        slope = side * (first * first * one * a**3 + second * second * other * b**3) * inverse**3 - 1 / z
        moves = ~(np.abs(off) < _CLOSE * inverse)
        low, high = np.where(moves & (off > 0), t, low), np.where(moves & ~(off > 0), t, high)
        step = t - off / slope
        t = np.where(moves, np.where((low <= step) & (step <= high), step, (low + high) / 2), t)
    a, b = 1 / (1 + side * t * first), 1 / (1 + side * t * second)
    off = (np.sqrt(one * a * a + other * b * b) - length) / z
    return np.where((side > 0) & (white <= z), np.inf, off * off)


@compiled(_elements_at_once, **_FAST)
def elements(m, numbers, covariance, out, start, stop):  # type: ignore[no-untyped-def]
    """`VectorNoise` (11, pixels) of elements over m00, of m (16, pixels) with covariance (16, 16, pixels)."""
    n = len(numbers)
    c, v, by = np.empty((n, n, _RUN), np.float32), np.empty((n, _RUN), np.float32), np.empty((n, _RUN), np.float32)
    scale, sums = np.empty(_RUN, np.float32), np.empty((4, _RUN), np.float32)
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
        _moments(c, v, by, sums, out, first, count)


@compiled(_slopes_at_once, **_FAST)
def slopes(vector, by_element, covariance, out, start, stop):  # type: ignore[no-untyped-def]
    """The same of a vector (n, pixels) with its gradient (n, 16, pixels)."""
    n = len(by_element)
    c, v, by = np.empty((n, n, _RUN), np.float32), np.empty((n, _RUN), np.float32), np.empty((n, _RUN), np.float32)
    moved, sums = np.empty(_RUN, np.float32), np.empty((4, _RUN), np.float32)
    for first in range(start, stop, _RUN):
        count = min(_RUN, stop - first)
        for i in range(n):
            v[i, :count] = vector[i, first : first + count]
            for j in range(i + 1):
                c[i, j] = 0
            for k in range(16):
                moved[:] = 0
                for a in range(16):
                    _add_product(
                        moved, covariance[k, a, first : first + count], by_element[i, a, first : first + count]
                    )
                for j in range(i + 1):
                    _add_product(c[i, j], moved, by_element[j, k, first : first + count])
        _moments(c, v, by, sums, out, first, count)


@compiled(**_FAST)
def _add_product(total, a, b):  # type: ignore[no-untyped-def]
    for p in range(len(b)):
        total[p] += a[p] * b[p]


@compiled(**_FAST)
def _add_row(row, v, by, i, total, square):  # type: ignore[no-untyped-def]
    """Add up C v, tr C and tr C^2: a row i of the lower half of C."""
    for p in range(len(total)):
        by[i, p] = row[i, p] * v[i, p]
        total[p] += row[i, p]
        square[p] += row[i, p] * row[i, p]
    for j in range(i):
        for p in range(len(total)):
            square[p] += 2 * row[j, p] * row[j, p]
            by[i, p] += row[j, p] * v[j, p]
            by[j, p] += row[j, p] * v[i, p]


@compiled(**_FAST)
def _across(c, by, p):  # type: ignore[no-untyped-def]
    total = np.float32(0)
    for i in range(len(c)):
        total += c[i, i, p] * by[i, p] * by[i, p]
        for j in range(i):
            total += 2 * by[i, p] * c[i, j, p] * by[j, p]
    return total


@compiled(**_FAST)
def _moments(c, v, by, sums, out, first, count):  # type: ignore[no-untyped-def]
    """`vector_noise.VectorNoise` of vectors v (n, pixels) and their covariance, the lower half of which is filled.

    Parameters
    ----------
    by, sums : (n, pixels) and (4, pixels), filled.
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
    for p in range(count):
        mixed, length = np.sqrt(turned[p] / size[p]), np.sqrt(size[p])
        # By how much noise along v turns it, and, where that matters, the noise along the direction to which it does.
        turn = DEVIATES[1] * mixed / (np.sqrt(along[p]) * length)
        across = np.float32(0)
        if turn * (2 * mixed + turn * total[p]) >= _ALIKE * along[p]:
            across = _across(c, by, p) / turned[p]
        _reach(length, along[p], mixed, across, out[3:5, first + p])
    place = 5
    for apart in range(3):
        for i in range(3 - apart):
            packed = out[place, first : first + count]
            packed[:] = np.nan
            if i + apart < n:
                packed[:] = c[i + apart, i, :count]
            place += 1


@compiled(**_FAST)
def _reach(length, along, mixed, across, out):  # type: ignore[no-untyped-def]
    """`below` and `above` of a vector (length, 0) of covariance ((along, mixed), (mixed, across))."""
    half, centre = (along - across) / 2, (along + across) / 2
    z = DEVIATES[1]
    # By how much z errors along v turn it, and what the variance along it then is.
    turn = z * mixed / (np.sqrt(along) * length)
    if turn * (2 * mixed + turn * across) < _ALIKE * along:
        out[0] = along if length * length > z * z * along else np.inf
        out[1] = along
        return
    radius = np.sqrt(half * half + mixed * mixed)
    first, second = centre + radius, max(centre - radius, 1e-6 * centre)
    # Square of the component of v along the first axis.
    one = length * length * (1 + half / radius) / 2
    other = length * length - one
    out[0] = _farthest(length, first, second, one, other, z, 1.0)
    out[1] = _farthest(length, first, second, one, other, z, -1.0)


@compiled(**_FAST)
def _farthest(length, first, second, one, other, z, side):  # type: ignore[no-untyped-def]
    """By Newton's method on the multiplier t of mu = (1 + side t C)^-1 v, which is that far from v."""
    low, high, t = 0.0, 1 / first, 0.0
    if side > 0:
        white = np.sqrt(one / first + other / second)
        if white <= z:
            return np.inf
        # Where the asymptote of the function is zero: it lies below that, and is concave.
        high = t = (one / first**2 + other / second**2) / white**3 / (1 / z - 1 / white)
    a = b = 1.0
    for _ in range(_STEPS):
        a, b = 1 / (1 + side * t * first), 1 / (1 + side * t * second)
        inverse = 1 / np.sqrt(first * one * a * a + second * other * b * b)
        off = inverse - t / z
        if abs(off) < _CLOSE * inverse:
            break
        slope = side * (first * first * one * a**3 + second * second * other * b**3) * inverse**3 - 1 / z
        if off > 0:
            low = t
        else:
            high = t
        t -= off / slope
        if not low <= t <= high:
            t = (low + high) / 2
    a, b = 1 / (1 + side * t * first), 1 / (1 + side * t * second)
    off = (np.sqrt(one * a * a + other * b * b) - length) / z
    return off * off


def _mixed(table: Array, i: Any, x: Any, j: Any, y: Any, k: Any, z: Any) -> Any:
    a = (1 - z) * table[i, j, k] + z * table[i, j, k + 1]
    b = (1 - z) * table[i, j + 1, k] + z * table[i, j + 1, k + 1]
    c = (1 - z) * table[i + 1, j, k] + z * table[i + 1, j, k + 1]
    d = (1 - z) * table[i + 1, j + 1, k] + z * table[i + 1, j + 1, k + 1]
    return (1 - x) * ((1 - y) * a + y * b) + x * ((1 - y) * c + y * d)


_at = compiled()(_mixed)


def _narrower(half: Any, deviate: Any, share: Any, first: Any) -> Any:
    """Half an interval of a table, without the noise along the vector that its first node has more than there is."""
    rest = half * half - deviate * deviate * np.maximum(first - share, 0.0)
    return np.sqrt(np.maximum(rest, np.minimum(deviate * deviate * share, half * half)))


_narrowed = compiled()(_narrower)


def _places(values: Array, nodes: Array) -> tuple[NDArray[np.intp], Array]:
    i = np.clip(np.searchsorted(nodes, values, side="right") - 1, 0, len(nodes) - 2)
    return i, np.clip((values - nodes[i]) / (nodes[i + 1] - nodes[i]), 0.0, 1.0)


@in_parts
def _lengths_at_once(table: Array, nodes: tuple[Array, ...], given: Array, out: Array, part: slice) -> None:
    with np.errstate(all="ignore"):
        length, along, total, square, below, above = given[:, part]
        unit, components, farthest = np.sqrt(square / total), total * total / square, nodes[2][-1]
        seen = length / unit
        valid = np.isfinite(seen) & (seen >= 0) & np.isfinite(components) & np.isfinite(along)
        seen, near = np.where(valid, seen, 0.0), seen < farthest
        (i, x), (k, z) = _places(components, nodes[0]), _places(seen, nodes[2])
        far, ends = np.sqrt(np.maximum(seen * seen - components + along / unit**2, 1.0)), []
        for n, variance in enumerate((along, along, below, above)):
            share = variance / unit**2
            j, y = _places(share / np.sqrt(components), nodes[1])
            spread = np.sqrt(share + np.maximum(components - share * share, 0.0) / (2 * far * far))
            beyond = far + (2 * (n % 2) - 1) * DEVIATES[n // 2] * spread
            end = np.where(near, _mixed(table[n], i, x, j, y, k, z), beyond)
            ends.append(np.where(np.isinf(share), 0.0, end))
        low, high, low_95, high_95 = ends
        limit = np.minimum(high * high / _mixed(table[4], i, x, j, y, k, z), high)
        value = np.where(low > 0, low + high, limit) / 2
        first, narrow = nodes[1][0] * np.sqrt(components), near & (low > 0)
        error = np.where(near & ~narrow, np.maximum(high - value, LEAST), high - value)
        error = np.where(narrow, _narrower(error, DEVIATES[0], along / unit**2, first), error)
        outer = []
        for side, end, variance in ((-1, low_95, below), (1, high_95, above)):
            half = _narrower(side * (end - value), DEVIATES[1], variance / unit**2, first)
            outer.append(np.where(narrow & (end > 0), value + side * half, end))
        interval = np.stack([value, error, np.maximum(outer[0], 0.0), outer[1]]) * unit
        out[:, part] = np.where(valid, interval, np.nan)


@compiled(_lengths_at_once, error_model="numpy")
def lengths(table, nodes, given, out, start, stop):  # type: ignore[no-untyped-def]
    """`magnitude.Interval` (4, pixels) of length, along, total, square, below and above (6, pixels)."""
    ends = np.empty(4)
    step, farthest, last = nodes[2][1] - nodes[2][0], nodes[2][-1], len(nodes[2]) - 1
    for p in range(start, stop):
        length, along, total, square = given[0, p], given[1, p], given[2, p], given[3, p]
        unit = np.sqrt(square / total)
        components, seen = total * total / square, length / unit
        # A length over a negative m00 is none.
        if not (np.isfinite(seen) and seen >= 0 and np.isfinite(components) and np.isfinite(along)):
            out[:, p] = np.nan
            continue
        i, x = _place(components, nodes[0])
        k = min(int(seen / step), last - 1)
        z = min(seen / step - k, 1.0)
        # Far from zero: noise across adds its square, and its scatter.
        far = np.sqrt(max(seen * seen - components + along / unit**2, 1.0))
        j, y = 0, 0.0
        for n in range(4):
            # Those of the 68 % interval are along the vector itself.
            share = given[1 if n < 2 else 2 + n, p] / unit**2
            if np.isinf(share):
                ends[n] = 0.0
            elif seen < farthest:
                j, y = _place(share / np.sqrt(components), nodes[1])
                ends[n] = _at(table[n], i, x, j, y, k, z)
            else:
                spread = np.sqrt(share + max(components - share * share, 0.0) / (2 * far * far))
                ends[n] = far + (2 * (n % 2) - 1) * DEVIATES[n // 2] * spread
        low, high = ends[0], ends[1]
        if low > 0:
            value = (low + high) / 2
        else:
            # Of an upper limit alone the value goes to zero with what is observed.
            value = min(high * high / _at(table[4], i, x, j, y, k, z), high) / 2
        error = high - value
        if seen < farthest and low <= 0:
            error = max(error, LEAST)
        elif seen < farthest:
            first = nodes[1][0] * np.sqrt(components)
            error = _narrowed(error, DEVIATES[0], along / unit**2, first)
            for n in (2, 3):
                if ends[n] > 0:
                    share, side = given[2 + n, p] / unit**2, 2 * n - 5
                    ends[n] = value + side * _narrowed(side * (ends[n] - value), DEVIATES[1], share, first)
        out[0, p], out[1, p] = value * unit, error * unit
        out[2, p], out[3, p] = max(ends[2], 0.0) * unit, ends[3] * unit


@compiled()
def _place(value, nodes):  # type: ignore[no-untyped-def]
    """Node below a value, and how far it is to the next: 0 to 1."""
    i = 0
    while i < len(nodes) - 2 and value >= nodes[i + 1]:
        i += 1
    return i, min(max((value - nodes[i]) / (nodes[i + 1] - nodes[i]), 0.0), 1.0)


def _interpolate_at_once(table: Array, places: Array, out: Array) -> None:
    @in_parts
    def each(part: slice) -> None:
        last = np.array(table.shape[:3])[:, None] - 1
        inside = np.minimum(places[:, part], last)
        node = np.minimum(inside.astype(int), last - 1)
        places_in_cells = [w for i, x in zip(node, (inside - node)[..., None], strict=True) for w in (i, x)]
        out[:, part] = _mixed(table, *places_in_cells).T

    each(0, places.shape[1])


@compiled(_interpolate_at_once)
def interpolate(table, places, out):  # type: ignore[no-untyped-def]
    """Linear interpolation of all planes of a table (n, m, k, planes) at `places` (3, pixels); beyond it the last."""
    last = (table.shape[0] - 1, table.shape[1] - 1, table.shape[2] - 1)
    for p in range(places.shape[1]):
        x, y, z = min(places[0, p], last[0]), min(places[1, p], last[1]), min(places[2, p], last[2])
        i, j, k = int(x), int(y), int(z)
        x, y, z = x - i, y - j, z - k
        i1, j1, k1 = min(i + 1, last[0]), min(j + 1, last[1]), min(k + 1, last[2])
        for n in range(table.shape[3]):
            a = (1 - z) * table[i, j, k, n] + z * table[i, j, k1, n]
            b = (1 - z) * table[i, j1, k, n] + z * table[i, j1, k1, n]
            c = (1 - z) * table[i1, j, k, n] + z * table[i1, j, k1, n]
            d = (1 - z) * table[i1, j1, k, n] + z * table[i1, j1, k1, n]
            out[n, p] = (1 - x) * ((1 - y) * a + y * b) + x * ((1 - y) * c + y * d)
