"""Inversion where W differs from pixel to pixel: a retardance that varies smoothly over the image.

A pseudo-inverse for each pixel would take minutes. W and its pseudo-inverse are smooth functions of the few retardances
that vary, so they are worked out at a few nodes of these and interpolated by polynomials; every pixel then costs one
matrix product with the nodes' stacked matrices. More nodes are taken until the interpolation is good to TOLERANCE.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from processing.correction import Mask
from processing.errors import NotDetermined
from processing.inversion import ELEMENTS
from processing.mueller_solver import MuellerSolver
from processing.threads import for_ranges

TILE = 2048
#: Largest error of an interpolated pseudo-inverse, relative to its largest element.
TOLERANCE = 1e-5
NODES = (3, 4, 5, 6, 8, 11)


@dataclass(frozen=True)
class Field:
    """What varies over the image.

    Attributes
    ----------
    matrix : from the extra retardances (E,) of the E elements, radians, to W (L, 16), rows scaled with the exposure.
    extra : from x, y (pixels,) to the extra retardances (E, pixels); x and y from -1 to 1, to the right and down.
    """

    matrix: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    extra: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


class FieldSolver:
    """Least squares with W of each pixel's place; the same interface as MuellerSolver.

    Values and residual are those of the place. Standard errors are those of the image's centre: they change with the
    place far less than the values do. Saturated intensities are not left out; their pixels are not determined.

    Parameters
    ----------
    plain : solver with W of the centre.
    field : W and what varies over the image.

    Raises
    ------
    NotDetermined : W changes too fast over the image for this method.
    """

    def __init__(self, plain: MuellerSolver, field: Field) -> None:
        self.plain, self.reader, self.inversion = plain, plain.reader, plain.inversion
        self.noise, self.repeats, self.intensity_floor = plain.noise, plain.repeats, plain.intensity_floor
        self.field = field
        y, x = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41), indexing="ij"))
        extra = field.extra(x, y)
        self._middle = (extra.max(axis=1) + extra.min(axis=1)) / 2
        # A little room, because the extremes between the samples may lie outside.
        self._half = np.maximum(1.02 * (extra.max(axis=1) - extra.min(axis=1)) / 2, 1e-9)
        self.nodes, self._pinv, self._w = _interpolation(field, self._middle, self._half)

    def solve(self, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Mueller elements, errors, residual and mask of frames (N, channels, pixels) that the reader just read."""
        found = self.plain.estimate(frames)
        for_ranges(frames.shape[2], lambda a, b: self._range(frames, a, b, found), align=TILE, smallest=TILE)
        saturated = (found["pixel_mask"] & np.uint8(Mask.SATURATED)) != 0
        found["pixel_mask"][saturated] |= np.uint8(Mask.NOT_DETERMINED)
        return found

    def _range(self, frames: NDArray[Any], start: int, stop: int, found: dict[str, NDArray[Any]]) -> None:
        n = self.inversion.w.shape[0]
        for a in range(start, stop, TILE):
            b = min(a + TILE, stop)
            signal = np.empty((*frames.shape[:2], b - a), np.float32)
            self.reader.signal(frames[:, :, a:b], slice(a, b), signal)
            basis = self._basis(np.arange(a, b))
            m = _sum(self._pinv @ signal.reshape(n, b - a), basis, ELEMENTS)
            before = found["residual_rms"][a:b].copy()
            residual = signal.reshape(n, b - a) - _sum(self._w @ m, basis, n)
            found["mueller"][:, a:b] = m
            found["residual_rms"][a:b] = np.sqrt(np.mean(residual**2, axis=0))
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.where(before > 0, found["residual_rms"][a:b] / before, 1.0)
            found["reduced_chi_square"][a:b] *= ratio**2
            if self.noise is None:
                found["mueller_errors"][:, a:b] *= ratio

    def _basis(self, pixels: NDArray[np.int64]) -> NDArray[np.float32]:
        """Polynomials (nodes^E, pixels) at pixels of the block that was read last."""
        height, width = self.reader.capture.frame_shape
        row, column = np.divmod(pixels, width)
        extra = self.field.extra(_centred(column, width), _centred(row + self.reader.first_row, height))
        scaled = (extra - self._middle[:, None]) / self._half[:, None]
        return np.ascontiguousarray(_products(scaled, self.nodes), dtype=np.float32)


def _centred(index: NDArray[np.int64], size: int) -> NDArray[np.float64]:
    return np.asarray(2.0 * index / max(size - 1, 1) - 1.0)


def _sum(stacked: NDArray[np.float32], basis: NDArray[np.float32], rows: int) -> NDArray[np.float32]:
    out = stacked[:rows] * basis[0]
    for k in range(1, len(basis)):
        out += stacked[k * rows : (k + 1) * rows] * basis[k]
    return np.asarray(out)


def _products(scaled: NDArray[np.float64], nodes: int) -> NDArray[np.float64]:
    """Products (nodes^E, pixels) of Chebyshev polynomials of E variables (E, pixels) from -1 to 1."""
    out = np.ones((1, scaled.shape[1]))
    for variable in scaled:
        table = chebyshev.chebvander(variable, nodes - 1).T
        out = (out[:, None] * table[None]).reshape(-1, scaled.shape[1])
    return out


def _interpolation(
    field: Field, middle: NDArray[np.float64], half: NDArray[np.float64]
) -> tuple[int, NDArray[np.float32], NDArray[np.float32]]:
    """Number of nodes for each variable, and stacked coefficients of pinv(W) and W."""
    trials = np.random.default_rng(0).uniform(-1, 1, (len(middle), 6))
    true = [np.linalg.pinv(field.matrix(middle + half * t)) for t in trials.T]
    worst = np.inf
    for nodes in NODES:
        axis = chebyshev.chebpts1(nodes)
        at = np.stack([a.ravel() for a in np.meshgrid(*[axis] * len(middle), indexing="ij")])
        w = np.stack([field.matrix(middle + half * p) for p in at.T])
        back = np.linalg.inv(_products(at, nodes).T)
        pinv, rows = (np.einsum("kp,prc->krc", back, grid) for grid in (np.linalg.pinv(w), w))
        found = np.einsum("kp,krc->prc", _products(trials, nodes), pinv)
        worst = max(float(np.max(np.abs(f - t)) / np.max(np.abs(t))) for f, t in zip(found, true, strict=True))
        if worst < TOLERANCE:
            stacks = [np.ascontiguousarray(b.reshape(-1, b.shape[-1]), dtype=np.float32) for b in (pinv, rows)]
            return nodes, stacks[0], stacks[1]
    raise NotDetermined(
        f"the instrument's field_retardance changes W so fast that {NODES[-1]} nodes a retarder leave an error of "
        f"{worst:.1g}; check its coefficients."
    )
