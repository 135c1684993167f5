"""Loops over pixels behind `vector_noise`, `magnitude` and `sorted_eigenvalues`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.compiling import compiled, in_parts

#: Of the 68 and 95 % interval.
DEVIATES = (1.0, 1.959964)
#: Error of a short length at least, in units of the noise: an observed one far below what noise alone makes allows
#: hardly any length.
LEAST = 0.55
#: Newton's method: steps at most, and relative error at which it ends.
_STEPS, _CLOSE = 6, 3e-3
#: A variance that changes by less than this part is taken as it is.
_ALIKE = 0.08

_FAST: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"}}


@in_parts
def _elements_at_once(m: Array, numbers: NDArray[np.int64], covariance: Array, out: Array, part: slice) -> None:
    m, covariance = m[part].astype(float), covariance[part].astype(float)
    v = m[:, numbers] / m[:, :1]
    by = covariance[:, 0, numbers] - v * covariance[:, 0, :1] / 2
    c = covariance[:, numbers[:, None], numbers] - v[:, None] * by[..., None] - v[..., None] * by[:, None]
    _moments_at_once(c / m[:, :1, None] ** 2, v, out[:, part])


@in_parts
def _slopes_at_once(vector: Array, by_element: Array, covariance: Array, out: Array, part: slice) -> None:
    by = np.moveaxis(by_element[:, part].astype(float), 0, 1)
    _moments_at_once(by @ covariance[part] @ np.swapaxes(by, 1, 2), vector[:, part].T.astype(float), out[:, part])


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
    n = len(numbers)
    c, v, by = np.empty((n, n), np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    for p in range(start, stop):
        scale = np.float32(1) / m[p, 0]
        for i in range(n):
            v[i] = m[p, numbers[i]] * scale
            # Of m_i - v_i m00 / 2: with it the noise of m00 is two products.
            by[i] = covariance[p, 0, numbers[i]] - np.float32(0.5) * v[i] * covariance[p, 0, 0]
        scale *= scale
        for i in range(n):
            for j in range(i + 1):
                c[i, j] = (covariance[p, numbers[i], numbers[j]] - v[j] * by[i] - v[i] * by[j]) * scale
        _moments(c, v, out, p)


@compiled(_slopes_at_once, **_FAST)
def slopes(vector, by_element, covariance, out, start, stop):  # type: ignore[no-untyped-def]
    n = len(by_element)
    c, by = np.empty((n, n), np.float32), np.empty(16, np.float32)
    for p in range(start, stop):
        for i in range(n):
            for k in range(16):
                by[k] = 0
                for a in range(16):
                    by[k] += covariance[p, k, a] * by_element[i, p, a]
            for j in range(i + 1):
                c[i, j] = 0
                for k in range(16):
                    c[i, j] += by[k] * by_element[j, p, k]
        _moments(c, vector[:, p], out, p)


@compiled(**_FAST)
def _moments(c, v, out, p):  # type: ignore[no-untyped-def]
    """`vector_noise.VectorNoise` of a vector v and its covariance, the lower half of which is filled."""
    n = len(c)
    by = np.empty(n, np.float32)
    total, square, along, size = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
    for i in range(n):
        by[i] = c[i, i] * v[i]
        total += c[i, i]
        size += v[i] * v[i]
        square += c[i, i] * c[i, i] / 2
        for j in range(i):
            square += c[i, j] * c[i, j]
            by[i] += c[i, j] * v[j]
            by[j] += c[i, j] * v[i]
    square *= 2
    for i in range(n):
        along += by[i] * v[i]
    along /= size
    out[0, p], out[1, p], out[2, p] = along, total, square
    turned, across = np.float32(0), np.float32(0)
    for i in range(n):
        by[i] -= along * v[i]
        turned += by[i] * by[i]
    mixed = np.sqrt(turned / size)
    # By how much noise along v turns it, and, where that matters, the noise along the direction to which it does.
    turn = DEVIATES[1] * mixed / np.sqrt(along * size)
    if turn * (2 * mixed + turn * total) >= _ALIKE * along:
        for i in range(n):
            across += c[i, i] * by[i] * by[i]
            for j in range(i):
                across += 2 * by[i] * c[i, j] * by[j]
        across /= turned
    _reach(np.sqrt(size), along, mixed, across, out[3:5, p])
    place = 5
    for apart in range(3):
        for i in range(3 - apart):
            out[place, p] = c[i + apart, i] if i + apart < n else np.nan
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
