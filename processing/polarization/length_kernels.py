"""Loops over pixels behind `magnitude`, and tables of three coordinates, as `sorted_eigenvalues` has them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.compiling import compiled, in_parts
from processing.polarization.vector_kernels import FAST

#: Of the 68 and 95 % interval.
DEVIATES = (1.0, 1.959964)
#: Least error of a short length, in units of the noise: a far smaller observed one allows hardly any length.
LEAST = 0.55
#: Newton's method: steps at most, the error of the root at which it ends, and the change of a vector, as a part of it,
#: for which the first guess is enough (0.06 errors off in one of a hundred).
_STEPS, _CLOSE, _ALIKE = 8, 0.02, 0.2
#: Pixels whose bounds are tried at once.
_TILE = 256
#: Observed length over sqrt(tr C) up to which an interval is that of the table alone, and where its share ends.
NEAR, FAR = 1.0, 1.5
#: [standard errors] By which one noise across lengthens a vector: up to the first the root counts in full, beyond the
#: second not at all. A vector along a direction of little noise may have a part across that noise has hidden.
SWAY = (0.4, 0.8)


def _mixed(table: Array, i: Any, x: Any, j: Any, y: Any, k: Any, z: Any) -> Any:
    a = (1 - z) * table[i, j, k] + z * table[i, j, k + 1]
    b = (1 - z) * table[i, j + 1, k] + z * table[i, j + 1, k + 1]
    c = (1 - z) * table[i + 1, j, k] + z * table[i + 1, j, k + 1]
    d = (1 - z) * table[i + 1, j + 1, k] + z * table[i + 1, j + 1, k + 1]
    return (1 - x) * ((1 - y) * a + y * b) + x * ((1 - y) * c + y * d)


_at = compiled()(_mixed)


def _plane(length: Any, along: Any, total: Any, square: Any, mixed: Any, across: Any, further: Any) -> Any:
    """Covariance C by its part in the plane of v and C v, and the moments of the rest.

    Variances along both axes of the plane, squares of the components of v along them, and of the rest how many
    directions it has and their variance. Then, where the length is the observed one, the inverse slope of
    `_modified_root`, minus its value, the variance normal to vectors of equal length, and the inverse of the largest
    variance. `mixed` and `further` are squares.
    """
    half, centre = (along - across) / 2, (along + across) / 2
    radius = np.sqrt(half * half + mixed + 1e-20 * centre * centre)
    first, second = centre + radius, np.maximum(centre - radius, 1e-6 * centre)
    one = length * length * (1 + half / radius) / 2
    other = length * length - one
    rest = np.maximum(total - along - across, 1e-6 * total)
    spread = square - along * along - across * across - 2 * (mixed + further)
    spread = np.minimum(np.maximum(spread, rest * rest / 17), rest * rest)
    noise, largest = first * one + second * other, np.maximum(first, spread / rest)
    normal, scale = (first * first * one + second * second * other) / noise, 1 / np.sqrt(noise)
    bias = (first + second + rest - normal) * scale / 2
    return first, second, one, other, rest * rest / spread, spread / rest, scale, bias, normal, 1 / largest


def _first_guess(deviate: Any, scale: Any, bias: Any, normal: Any, least: Any) -> Any:
    """Multiplier mu of `_modified_root` where that is `deviate`, to second order."""
    by = (deviate + bias) * scale
    mu = np.maximum(by / np.maximum(1 - by * normal, 0.5), -0.9 * least)
    # At zero the root's correction is a quotient of zeros.
    return mu + (np.abs(mu) < 1e-4 * least) * 2e-4 * least


def _modified_root(
    mu: Any, first: Any, second: Any, one: Any, other: Any, rest: Any, variance: Any
) -> tuple[Any, Any, Any, Any]:
    """Modified signed root (Barndorff-Nielsen, Biometrika 73, 307, 1986) of the length |(1 + mu C)^-1 v|.

    That vector is the likeliest one of its length. The root r of its likelihood ratio is mu sqrt(t'Ct), t being the
    vector. Noise across moves r by log(D) / 2r, D being the determinant of 1 + mu C in the plane normal to C^(1/2) t.

    Returns
    -------
    The root and its slope by mu, the length and the negative of its slope.
    """
    a, b, c = 1 / (1 + mu * first), 1 / (1 + mu * second), 1 / (1 + mu * variance)
    p, q = first * one * a * a, second * other * b * b
    noise, bent = p + q, p * a + q * b
    root, by = mu * np.sqrt(noise), bent / np.sqrt(noise)
    log = np.log(bent / (noise * a * b)) - rest * np.log(c)
    turned = 2 * (first * p * a + second * q * b) / noise - 3 * (first * p * a * a + second * q * b * b) / bent
    slope = by + (log * by / root - turned - first * a - second * b - rest * variance * c) / (2 * root)
    length = np.sqrt(one * a * a + other * b * b)
    return root - log / (2 * root), slope, length, bent / length


def _length_at(mu: Any, first: Any, second: Any, one: Any, other: Any) -> Any:
    a, b = 1 + mu * first, 1 + mu * second
    return np.sqrt(one * b * b + other * a * a) / (a * b)


def _shrunk(mu: Any, step: Any, least: Any) -> Any:
    """Multiplier after Newton's step towards smaller ones, in the inverse of 1 + mu / least, which stays positive."""
    shrink = least + mu
    return shrink * shrink / (shrink + step) - least


_place_in_plane, _root = compiled(**FAST)(_plane), compiled(**FAST)(_modified_root)
_guess, _length_of, _fewer = (compiled(**FAST)(each) for each in (_first_guess, _length_at, _shrunk))


def _share_of_root(over_noise: Any, variance: Any, scale: Any) -> Any:
    """Part that the root has in a bound, the rest being the table's, of a length over sqrt(tr C) and its `_plane`."""
    long = np.minimum(np.maximum((over_noise - NEAR) / (FAR - NEAR), 0.0), 1.0)
    return long * np.minimum(np.maximum((SWAY[1] - variance * scale / 2) / (SWAY[1] - SWAY[0]), 0.0), 1.0)


_share = compiled(**FAST)(_share_of_root)


def _places(values: Array, nodes: Array) -> tuple[NDArray[np.intp], Array]:
    i = np.clip(np.searchsorted(nodes, values, side="right") - 1, 0, len(nodes) - 2)
    return i, np.clip((values - nodes[i]) / (nodes[i + 1] - nodes[i]), 0.0, 1.0)


def _bounds_at_once(deviate: float, plane: tuple[Array, ...]) -> Array:
    guess, plane, least = plane[6:], plane[:6], plane[9]
    mu, low = _first_guess(deviate, *guess), -least
    moves = np.abs(mu) >= _ALIKE * least
    found = np.where(moves, 0.0, _length_at(mu, *plane[:4]))
    for _ in range(_STEPS):
        value, slope, length, by = _modified_root(mu, *plane)
        off = value - deviate
        is_close = moves & (np.abs(off) < _CLOSE) & (slope > 0)
        found = np.where(is_close, length + by * off / slope, found)
        moves &= ~is_close & ((off > 0) | (slope > 0))
        low = np.where(off < 0, mu, low)
        down = np.where(slope > 0, _shrunk(mu, off / slope, least), (low + mu) / 2)
        mu = np.where(moves, np.where(off > 0, down, mu - off / slope), mu)
    return np.maximum(found, 0.0)


@compiled(**FAST)
def _bound(deviate, plane):  # type: ignore[no-untyped-def]
    """Length at which the modified root is `deviate`; 0 where there is none."""
    first, second, one, other, rest, variance, scale, bias, normal, least = plane
    mu, low = _guess(deviate, scale, bias, normal, least), -least
    if abs(mu) < _ALIKE * least:
        return _length_of(mu, first, second, one, other)
    for _ in range(_STEPS):
        value, slope, length, by = _root(mu, first, second, one, other, rest, variance)
        off = value - deviate
        if abs(off) < _CLOSE and slope > 0:
            return max(length + by * off / slope, 0.0)
        if off > 0:
            mu = _fewer(mu, off / slope, least) if slope > 0 else (low + mu) / 2
        elif slope > 0:
            low = mu
            mu -= off / slope
        else:
            return 0.0
    return 0.0


@in_parts
def _lengths_at_once(table: Array, nodes: tuple[Array, ...], given: Array, out: Array, part: slice) -> None:
    with np.errstate(all="ignore"):
        length, along, total, square, mixed, across, further, far = given[:, part]
        unit, components = np.sqrt(square / total), total * total / square
        seen = length / unit
        valid = np.isfinite(seen) & (seen >= 0) & np.isfinite(components) & np.isfinite(along)
        (i, x), (j, y) = _places(components, nodes[0]), _places(along / unit**2 / np.sqrt(components), nodes[1])
        u, ends = unit**2, []
        for n in range(4):
            wide = np.sqrt(far) if n > 1 else np.ones_like(far)
            one = np.where(valid, seen / wide, 0.0)
            k, z = _places(one, nodes[2])
            end = _mixed(table[n], i, x, j, y, k, z) + np.maximum(one - nodes[2][-1], 0.0)
            plane = _plane(one, along / u, total / u, square / u**2, mixed / u**2, across / u, further / u**2)
            bound = _bounds_at_once((1 - 2 * (n % 2)) * DEVIATES[n // 2], plane)
            share = _share_of_root(one / np.sqrt(components), plane[5], plane[6])
            # The noise along the observed vector can be far less than that along the true one.
            share = np.where((n == 3) & (bound > end), 1.0, share)
            bound = np.where((across == 0) & (one < nodes[2][-1]), 0.0, bound)
            ends.append(np.where(bound > 0, end + share * (bound - end), end) * wide)
            if n < 2:
                limit = _mixed(table[4], i, x, j, y, k, z)
        low, high, low_95, high_95 = ends
        low_95, high_95 = np.minimum(low_95, low), np.maximum(high_95, high)
        value = np.where(low > 0, low + high, np.minimum(high * high / limit, high)) / 2
        error = np.where(low > 0, high - value, np.maximum(high - value, LEAST))
        interval = np.stack([value, error, np.maximum(low_95, 0.0), high_95]) * unit
        out[:, part] = np.where(valid, interval, np.nan)


@compiled(**FAST)
def _long_lengths(given, out, is_done, first, count, seen):  # type: ignore[no-untyped-def]
    """Bounds of pixels where each is that of the root alone, and the first guess; whether they are: `is_done`.

    There are no branches, so that several pixels are computed at once. `seen` is the last node of the table.
    """
    for k in range(count):
        p = first + k
        length, along, total, square, across = given[0, p], given[1, p], given[2, p], given[3, p], given[5, p]
        a, b, one, other, _, variance, scale, bias, normal, least = _place_in_plane(
            length, along, total, square, given[4, p], across, given[6, p]
        )
        wide = np.sqrt(given[7, p])
        mu, mu_high = _guess(DEVIATES[0], scale, bias, normal, least), _guess(-DEVIATES[0], scale, bias, normal, least)
        low, high = _length_of(mu, a, b, one, other), _length_of(mu_high, a, b, one, other)
        most = max(abs(mu), abs(mu_high))
        one, other, scale, bias = one / given[7, p], other / given[7, p], scale * wide, bias * wide
        mu, mu_high = _guess(DEVIATES[1], scale, bias, normal, least), _guess(-DEVIATES[1], scale, bias, normal, least)
        low_95, high_95 = _length_of(mu, a, b, one, other) * wide, _length_of(mu_high, a, b, one, other) * wide
        most = max(most, max(abs(mu), abs(mu_high)))
        is_far = (across > 0) | (length * length * total >= seen * seen * given[7, p] * square)
        is_long = (length >= FAR * wide * np.sqrt(total)) & (variance * scale <= 2 * SWAY[0]) & is_far
        is_done[k] = is_long & (most < _ALIKE * least)
        out[0, p], out[1, p] = (low + high) / 2, (high - low) / 2
        out[2, p], out[3, p] = max(min(low_95, low), 0.0), max(high_95, high)


@compiled(_lengths_at_once, **FAST)
def lengths(table, nodes, given, out, start, stop):  # type: ignore[no-untyped-def]
    """`magnitude.Interval` (4, pixels) of the eight numbers of each pixel, see `magnitude.interval`."""
    ends, is_done = np.empty(4), np.ones(_TILE, np.bool_)
    step, last = nodes[2][1] - nodes[2][0], len(nodes[2]) - 1
    for p in range(start, stop):
        if (p - start) % _TILE == 0 and is_done.any():
            _long_lengths(given, out, is_done, p, min(_TILE, stop - p), nodes[2][last])
        if is_done[(p - start) % _TILE]:
            continue
        length, along, total, square = given[0, p], given[1, p], given[2, p], given[3, p]
        unit = np.sqrt(square / total)
        components, seen = total * total / square, length / unit
        # A length over a negative m00 is none.
        if not (np.isfinite(seen) and seen >= 0 and np.isfinite(components) and np.isfinite(along)):
            out[:, p] = np.nan
            continue
        i, x, j, y, k, z = -1, 0.0, 0, 0.0, 0, 0.0
        plane = (0.0,) * 10
        u = unit * unit
        along, total, square = along / u, total / u, square / u**2
        mixed, across, further = given[4, p] / u**2, given[5, p] / u, given[6, p] / u**2
        for n in range(4):
            wide = np.sqrt(given[7, p]) if n > 1 else 1.0
            one = seen / wide
            over_noise, share, bound = one / np.sqrt(components), 0.0, 0.0
            # Of noise that is known along the vector alone the table is all.
            if (over_noise > NEAR or n == 3) and (across > 0 or one >= nodes[2][-1]):
                if n == 0 or plane[0] == 0 or given[7, p] != 1:
                    plane = _place_in_plane(one, along, total, square, mixed, across, further)
                share = _share(over_noise, plane[5], plane[6])
                bound = _bound((1 - 2 * (n % 2)) * DEVIATES[n // 2], plane)
            if bound > 0 and share >= 1:
                ends[n] = bound * wide
                continue
            if i < 0:
                i, x = _place(components, nodes[0])
                j, y = _place(along / np.sqrt(components), nodes[1])
            k = min(int(one / step), last - 1)
            z = min(one / step - k, 1.0)
            ends[n] = _at(table[n], i, x, j, y, k, z) + max(one - nodes[2][last], 0.0)
            if bound > 0:
                share = 1.0 if n == 3 and bound > ends[n] else share
                ends[n] += share * (bound - ends[n])
            ends[n] *= wide
        low, high = ends[0], ends[1]
        if low > 0:
            value = (low + high) / 2
            error = high - value
        else:
            # Of an upper limit alone the value goes to zero with what is observed.
            k = min(int(seen / step), last - 1)
            z = min(seen / step - k, 1.0)
            value = min(high * high / _at(table[4], i, x, j, y, k, z), high) / 2
            error = max(high - value, LEAST)
        out[0, p], out[1, p] = value * unit, error * unit
        out[2, p], out[3, p] = max(min(ends[2], low), 0.0) * unit, max(ends[3], high) * unit


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
