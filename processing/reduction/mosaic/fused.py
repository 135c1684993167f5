"""Bilinear Stokes images of a mosaic in one pass over the raw frame: for live views and long series.

The same numbers as `methods/bilinear.py` followed by the solution for S, DoLP and AoLP, without the images between.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Image
from processing.computing.compiling import compiled
from processing.computing.threads import for_ranges
from processing.reduction.mosaic.layout import MosaicLayout

# atan(t) = t (a0 + a1 t^2 + ...) for 0 <= t <= 1: least squares at Chebyshev nodes; error 2e-8 before rounding.
_NODES = 0.5 * (1 - np.cos(np.pi * (np.arange(400) + 0.5) / 400))
_POWERS = _NODES[:, None] ** (2 * np.arange(9) + 1)
_ATAN = np.linalg.lstsq(_POWERS, np.arctan(_NODES), rcond=None)[0].astype(np.float32)
_A0, _A1, _A2, _A3, _A4, _A5, _A6, _A7, _A8 = (np.float32(a) for a in _ATAN)


class LinearStokes(NamedTuple):
    """Planes (rows, columns) float32; AoLP in radians, 0 to pi."""

    s0: Image
    s1: Image
    s2: Image
    dolp: Image
    aolp: Image


def bilinear_stokes(
    frame: NDArray[np.generic], layout: MosaicLayout, solve: NDArray[np.float64], out: LinearStokes | None = None
) -> LinearStokes:
    """S0, S1, S2, DoLP and AoLP of one mosaic frame, bilinear.

    Parameters
    ----------
    frame : (rows, columns), uint8, uint16 or float32, black subtracted or negligible.
    solve : (3, channels), from channel intensities to S.
    out : planes to fill again; the first touch of new memory costs as much as the arithmetic.
    """
    layout.check((frame.shape[0], frame.shape[1]))
    if out is None:
        out = LinearStokes(*(np.empty(frame.shape, np.float32) for _ in range(5)))
    # Columns of `solve` in the order of the positions (0, 0), (0, 1), (1, 0), (1, 1).
    order = [layout.offsets.index((r, c)) for r in range(2) for c in range(2)]
    m = np.ascontiguousarray(solve[:, order], dtype=np.float32)
    for_ranges(frame.shape[0], lambda a, b: _rows(frame, m, *out, a, b), 2, 128)
    return out


def _rows_at_once(
    frame: NDArray[Any], m: Image, s0: Image, s1: Image, s2: Image, dolp: Image, aolp: Image, first: int, last: int
) -> None:
    wide = np.pad(frame.astype(np.float32), 1, mode="reflect")[first : last + 2]
    planes = []
    for image in (wide[1:-1], (wide[:-2] + wide[2:]) / 2):
        pair = [image[:, 1:-1], (image[:, :-2] + image[:, 2:]) / 2]
        for plane in pair:
            planes.append(plane.copy())
        planes[-2][:, 1::2], planes[-1][:, 1::2] = pair[1][:, 1::2], pair[0][:, 1::2]
    channels = np.asarray(planes, dtype=np.float32)
    channels[:, 1::2] = np.roll(channels[:, 1::2], 2, axis=0)
    a, b, c = np.tensordot(m, channels, 1)
    s0[first:last], s1[first:last], s2[first:last] = a, b, c
    with np.errstate(divide="ignore", invalid="ignore"):
        dolp[first:last] = np.hypot(b, c) / a
    aolp[first:last] = np.arctan2(c, b) / 2 % np.pi


@compiled(_rows_at_once, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp", "nnan", "ninf"})
def _rows(frame, m, s0, s1, s2, dolp, aolp, first, last):  # type: ignore[no-untyped-def]
    height, width = frame.shape
    own, other = np.empty(width + 2, np.float32), np.empty(width + 2, np.float32)
    half, pi = np.float32(0.5), np.float32(np.pi)
    zero, tiny = np.float32(0.0), np.float32(1e-30)
    w = np.empty((3, 4), np.float32)
    for y in range(first, last):
        above = frame[y - 1 if y > 0 else 1]
        below = frame[y + 1 if y < height - 1 else height - 2]
        here = frame[y]
        for x in range(width):
            own[x + 1] = np.float32(here[x])
            other[x + 1] = half * (np.float32(above[x]) + np.float32(below[x]))
        own[0], own[width + 1] = own[2], own[width - 1]
        other[0], other[width + 1] = other[2], other[width - 1]
        # Own row first: for an odd row the two halves of the super-pixel change places.
        shift = 2 * (y % 2)
        for s in range(3):
            for p in range(4):
                w[s, p] = m[s, (p + shift) % 4]
        w00, w01, w02, w03 = w[0, 0], w[0, 1], w[0, 2], w[0, 3]
        w10, w11, w12, w13 = w[1, 0], w[1, 1], w[1, 2], w[1, 3]
        w20, w21, w22, w23 = w[2, 0], w[2, 1], w[2, 2], w[2, 3]
        r0, r1, r2, rd, ra = s0[y], s1[y], s2[y], dolp[y], aolp[y]
        for x in range(width):
            a, b = own[x + 1], half * (own[x] + own[x + 2])
            c, d = other[x + 1], half * (other[x] + other[x + 2])
            even = x % 2 == 0
            p0, p1 = (a, b) if even else (b, a)
            p2, p3 = (c, d) if even else (d, c)
            v0 = w00 * p0 + w01 * p1 + w02 * p2 + w03 * p3
            v1 = w10 * p0 + w11 * p1 + w12 * p2 + w13 * p3
            v2 = w20 * p0 + w21 * p1 + w22 * p2 + w23 * p3
            r0[x], r1[x], r2[x] = v0, v1, v2
            rd[x] = np.sqrt(v1 * v1 + v2 * v2) / v0
            ax, ay = abs(v1), abs(v2)
            t = min(ax, ay) / (max(ax, ay) + tiny)
            q = t * t
            angle = t * (
                _A0 + q * (_A1 + q * (_A2 + q * (_A3 + q * (_A4 + q * (_A5 + q * (_A6 + q * (_A7 + q * _A8)))))))
            )
            angle = half * pi - angle if ay > ax else angle
            angle = pi - angle if v1 < zero else angle
            angle = half * angle
            ra[x] = pi - angle if v2 < zero else angle
