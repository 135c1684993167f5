"""Demosaicing by linear minimum mean-square error, with kernels that turn along edges.

The four channels are combinations of S0, S1, S2 and of what the four analyzers leave unexplained (the closure).
Each is taken as a random field with a 1/f spectrum seen through lens and pixel; the best linear estimate of a
channel from the raw pixels around is then one kernel for each of the four positions in the super-pixel. Where a first
pass finds an edge, the fields are taken as smoother along it, and kernels for 16 directions stand ready. Constants
pass every kernel unchanged. The priors below were set on scenes that docs/studies/mosaic.md does not use.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from processing.arrays import Image
from processing.computing.compiling import PART, compiled
from processing.computing.filters import gaussian, separable
from processing.computing.threads import for_ranges
from processing.reduction.mosaic.layout import PAIRS, MosaicLayout

#: Kernels reach this many pixels to each side.
REACH = 4
DIRECTIONS = 16
#: Rows whose covariance is worked out at a time; an even number.
ROWS = 128
_ROWS_AT_ONCE = 16
#: How much farther the scene is alike along an edge than across.
STRETCH = 2.5

# Power spectrum 1 / (f^2 + LOWEST^2)^POWER, f in cycles a pixel, through a Gaussian lens and square pixels.
_POWER, _LOWEST, _LENS_PX = 1.2, 1 / 64, 0.4
# Variance of S1, S2 and the closure, and of the noise of a raw pixel, in units of that of S0.
_S1_S2, _CLOSURE, _NOISE = 0.3, 0.003, 0.003
# Makes constants pass exactly: their variance is as good as infinite.
_CONSTANT = 1e3

# An edge: gradients over about 3 pixels agree in direction by this much, and are this part of the signal a pixel.
_AGREEMENT, _CONTRAST, _SMOOTHING_PX = 0.6, 0.02, 1.5
_SCHARR, _SCHARR_SUM = (np.array([-1.0, 0.0, 1.0]), np.array([3.0, 10.0, 3.0])), 32.0


def channels(frame: Image, layout: MosaicLayout) -> NDArray[np.float32]:
    """Channels (4, rows, columns) of a mosaic frame; see the module's text."""
    out, direction, padded = _first_pass(frame, layout)
    kernels = _kernels(layout)
    for_ranges(frame.shape[0], lambda a, b: _along_edges(padded, kernels, direction, out, a, b), 2, 64)
    return out


def directions(frame: Image, layout: MosaicLayout) -> NDArray[np.uint8]:
    """Kernels that `channels` uses (rows, columns): 0 without direction, k > 0: edge along 180 (k - 1)/16 degrees."""
    return _first_pass(frame, layout)[1]


def covariance(
    variance: NDArray[np.float32], layout: MosaicLayout, solve: NDArray[np.float64], frame: Image
) -> NDArray[np.float32]:
    """Covariance (6, rows, columns) of (S0, S1, S2) by the kernels of each pixel; see `noise.stokes_covariance`."""
    out = np.empty((6, *variance.shape[1:]), np.float32)
    direction = directions(frame, layout)
    every = _noise_gain(layout, solve)
    packed = np.stack([every[..., a, b] for a, b in PAIRS]).astype(np.float32)
    # Few rows at a time: the weights of all pixels together would be larger than the image many times over.
    for first in range(0, variance.shape[1], ROWS):
        for i in range(2):
            for j in range(2):
                part = np.s_[first + i : first + ROWS : 2, j::2]
                weights = packed[:, direction[part], i, j]
                out[:, *part] = np.einsum("kxyc,cxy->kxy", weights, variance[:, *part])
    return out


def _noise_gain(layout: MosaicLayout, solve: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of S for unit variance of one channel: (1 + DIRECTIONS, 2, 2, channels, 3, 3).

    As `noise.noise_gain`, for each set of kernels.
    """
    kernels = _kernels(layout).astype(float)
    side = np.arange(-REACH, REACH + 1)
    dy, dx = (a.ravel() for a in np.meshgrid(side, side, indexing="ij"))
    to_stokes = np.einsum("sc,dijtc->dijts", solve, kernels)
    out = np.zeros((*kernels.shape[:3], len(layout.channels), 3, 3))
    for i in range(2):
        for j in range(2):
            for channel, (r, c) in enumerate(layout.offsets):
                taps = to_stokes[:, i, j, ((i + dy) % 2 == r) & ((j + dx) % 2 == c)]
                out[:, i, j, channel] = np.einsum("dts,dtu->dsu", taps, taps)
    return out


def _first_pass(
    frame: Image, layout: MosaicLayout
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32]]:
    """Channels without direction, the directions of edges, and the padded frame."""
    kernels = _kernels(layout)
    padded = np.pad(frame, REACH, mode="reflect")
    columns = np.ascontiguousarray(np.stack([padded[:, 0::2], padded[:, 1::2]]))
    out = np.empty((len(layout.channels), *frame.shape), np.float32)
    for_ranges(frame.shape[0], lambda a, b: _everywhere(columns, kernels[0], out, a, b), 2, 64)
    return out, _edges(out.mean(axis=0)), padded


def _edges(mean: Image) -> NDArray[np.uint8]:
    """For each pixel 0, or 1 + the direction of its edge in steps of 180 / DIRECTIONS degrees."""
    gx, gy = separable(mean, *_SCHARR), separable(mean, *_SCHARR[::-1])
    xx, xy, yy = (gaussian(p, _SMOOTHING_PX) for p in (gx * gx, gx * gy, gy * gy))
    along = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2
    agreement = np.hypot(xx - yy, 2 * xy) / (xx + yy + 1e-20)
    level = gaussian(np.abs(mean), _SMOOTHING_PX)
    edge = (agreement > _AGREEMENT) & (np.sqrt(xx + yy) / _SCHARR_SUM > _CONTRAST * level)
    step = np.rint(along / np.pi * DIRECTIONS).astype(np.int64) % DIRECTIONS
    return np.where(edge, step + 1, 0).astype(np.uint8)


@lru_cache(maxsize=4)
def _kernels(layout: MosaicLayout) -> NDArray[np.float32]:
    """(1 + DIRECTIONS, 2, 2, taps, channels): first without direction; axes 1 and 2 are the position."""
    shapes = [(0.0, 1.0), *((np.pi * k / DIRECTIONS, STRETCH) for k in range(DIRECTIONS))]
    return np.stack([_design(layout, angle, stretch) for angle, stretch in shapes]).astype(np.float32)


def _design(layout: MosaicLayout, angle: float, stretch: float) -> NDArray[np.float64]:
    side = np.arange(-REACH, REACH + 1)
    dy, dx = (a.ravel() for a in np.meshgrid(side, side, indexing="ij"))
    table = _correlation()
    middle = table.shape[0] // 2

    def alike(y: NDArray[np.int64], x: NDArray[np.int64]) -> NDArray[np.float64]:
        u = (x * np.cos(angle) + y * np.sin(angle)) / stretch
        v = -x * np.sin(angle) + y * np.cos(angle)
        return np.asarray(map_coordinates(table, [v + middle, u + middle], order=3) + _CONSTANT)

    around = alike(dy[:, None] - dy, dx[:, None] - dx)
    centre = alike(dy, dx)
    azimuth = np.deg2rad(layout.four_azimuths_deg())
    sign = np.where(np.cos(4 * azimuth) > 0, 1.0, -1.0)
    fields = 0.5 * np.stack([np.ones(4), np.cos(2 * azimuth), np.sin(2 * azimuth), sign / 2])
    variance = np.array([1.0, _S1_S2, _S1_S2, _CLOSURE])
    out = np.empty((2, 2, dy.size, 4))
    for row in range(2):
        for column in range(2):
            where = list(zip((row + dy) % 2, (column + dx) % 2, strict=True))
            seen = fields[:, [layout.offsets.index((int(r), int(c))) for r, c in where]]
            covariance = np.einsum("l,li,lj,ij->ij", variance, seen, seen, around)
            covariance += _NOISE * np.eye(dy.size)
            cross = np.einsum("l,lk,lj,j->jk", variance, fields, seen, centre)
            out[row, column] = np.linalg.solve(covariance, cross)
    return out


@lru_cache(maxsize=1)
def _correlation(size: int = 512) -> NDArray[np.float64]:
    f = np.fft.fftfreq(size)
    fy, fx = np.meshgrid(f, f, indexing="ij")
    r2 = fx**2 + fy**2
    spectrum = (r2 + _LOWEST**2) ** -_POWER
    spectrum *= np.exp(-((2 * np.pi * _LENS_PX) ** 2) * r2) * (np.sinc(fx) * np.sinc(fy)) ** 2
    found = np.fft.fftshift(np.fft.ifft2(spectrum).real)
    return np.asarray(found / found.max())


_FAST: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz"}}


def _windows(padded: Image) -> NDArray[np.float32]:
    return np.lib.stride_tricks.sliding_window_view(padded, (2 * REACH + 1, 2 * REACH + 1))


def _everywhere_at_once(columns: Image, kernel: Image, out: Image, first: int, last: int) -> None:
    around = _windows(np.stack([*columns], axis=-1).reshape(columns.shape[1], -1))
    # Few rows at a time, as their windows are copied.
    for start in range(first, last, _ROWS_AT_ONCE):
        for row, column in np.ndindex(2, 2):
            part = np.s_[start + row : min(start + _ROWS_AT_ONCE, last) : 2, column::2]
            values = around[part]
            mean = values.reshape(-1, kernel.shape[2]) @ kernel[row, column]
            out[:, *part] = mean.T.reshape(-1, *values.shape[:2])


@compiled(_everywhere_at_once, **_FAST)
def _everywhere(columns, kernel, out, first, last):  # type: ignore[no-untyped-def]
    """One kernel a position for some rows; `columns` are the padded frame's even and odd columns.

    Pixels of one parity stand side by side there, so the inner loop runs along them and becomes vector instructions.
    """
    side, half = 2 * REACH + 1, out.shape[2] // 2
    sums = np.empty((4, half), np.float32)
    a0, a1, a2, a3 = sums[0], sums[1], sums[2], sums[3]
    for y in range(first, last):
        for parity in range(2):
            sums[:] = np.float32(0.0)
            for i in range(side):
                for j in range(side):
                    k = kernel[y % 2, parity, i * side + j]
                    k0, k1, k2, k3 = k[0], k[1], k[2], k[3]
                    shift = (parity + j) // 2
                    source = columns[(parity + j) % 2, y + i, shift : shift + half]
                    for m in range(half):
                        value = source[m]
                        a0[m] += k0 * value
                        a1[m] += k1 * value
                        a2[m] += k2 * value
                        a3[m] += k3 * value
            for c in range(4):
                for m in range(half):
                    out[c, y, 2 * m + parity] = sums[c, m]


def _along_edges_at_once(
    padded: Image, kernels: Image, direction: NDArray[np.uint8], out: Image, first: int, last: int
) -> None:
    around = _windows(padded)
    rows, columns = np.nonzero(direction[first:last])
    for start in range(0, rows.size, PART):
        y, x = rows[start : start + PART] + first, columns[start : start + PART]
        kernel = kernels[direction[y, x], y % 2, x % 2]
        out[:, y, x] = np.einsum("nt,ntc->cn", around[y, x].reshape(len(y), -1), kernel)


@compiled(_along_edges_at_once, **_FAST)
def _along_edges(padded, kernels, direction, out, first, last):  # type: ignore[no-untyped-def]
    """Do the pixels on edges again, each with the kernels of its direction and position."""
    side = 2 * REACH + 1
    for y in range(first, last):
        for x in range(out.shape[2]):
            d = direction[y, x]
            if d == 0:
                continue
            k = kernels[d, y % 2, x % 2]
            s0 = s1 = s2 = s3 = np.float32(0.0)
            for i in range(side):
                row = padded[y + i]
                for j in range(side):
                    value = row[x + j]
                    t = i * side + j
                    s0 += k[t, 0] * value
                    s1 += k[t, 1] * value
                    s2 += k[t, 2] * value
                    s3 += k[t, 3] * value
            out[0, y, x], out[1, y, x], out[2, y, x], out[3, y, x] = s0, s1, s2, s3
