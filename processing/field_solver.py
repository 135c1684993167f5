"""Inversion where W differs from pixel to pixel: a retardance that varies smoothly over the image.

A pseudo-inverse for each pixel would take minutes. W and its pseudo-inverse are smooth functions of the place, so they
are worked out at a few nodes and interpolated by polynomials; every pixel then costs one matrix product with the nodes'
stacked matrices. More nodes are taken until the interpolation is good to TOLERANCE.
"""

from __future__ import annotations

from collections.abc import Callable
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
NODES = (3, 4, 5, 7)

#: W (L, 16) at a place; x and y from -1 to 1 over the image, to the right and down.
MatrixAt = Callable[[float, float], NDArray[np.float64]]


class FieldSolver:
    """Least squares with W of each pixel's place; the same interface as MuellerSolver.

    Values and residual are those of the place. Standard errors are those of the image's centre: they change with the
    place far less than the values do. Saturated intensities are not left out; their pixels are not determined.

    Parameters
    ----------
    plain : solver with W of the centre.
    matrix_at : W at any place, rows scaled with the exposure.

    Raises
    ------
    NotDetermined : W changes too fast over the image for this method.
    """

    def __init__(self, plain: MuellerSolver, matrix_at: MatrixAt) -> None:
        self.plain, self.reader, self.inversion = plain, plain.reader, plain.inversion
        self.noise, self.repeats = plain.noise, plain.repeats
        self.nodes, self._pinv, self._w = _interpolation(matrix_at)

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
        """Polynomials (nodes^2, pixels) at pixels of the block that was read last."""
        height, width = self.reader.capture.frame_shape
        row, column = np.divmod(pixels, width)
        y = _centred(row + self.reader.first_row, height)
        x = _centred(column, width)
        tx, ty = chebyshev.chebvander(x, self.nodes - 1), chebyshev.chebvander(y, self.nodes - 1)
        return np.asarray(np.einsum("pi,pj->ijp", ty, tx).reshape(-1, len(pixels)), dtype=np.float32)


def _centred(index: NDArray[np.int64], size: int) -> NDArray[np.float64]:
    return np.asarray(2.0 * index / max(size - 1, 1) - 1.0)


def _sum(stacked: NDArray[np.float32], basis: NDArray[np.float32], rows: int) -> NDArray[np.float32]:
    return np.asarray(np.einsum("krp,kp->rp", stacked.reshape(len(basis), rows, -1), basis))


def _interpolation(matrix_at: MatrixAt) -> tuple[int, NDArray[np.float32], NDArray[np.float32]]:
    """Number of nodes a side, and stacked Chebyshev coefficients of pinv(W) and W over the image."""
    places = ((-0.9, 0.55), (0.37, -0.81), (1.0, 1.0), (0.13, 0.02))
    for nodes in NODES:
        at = chebyshev.chebpts1(nodes)
        w = np.stack([[matrix_at(x, y) for x in at] for y in at])
        back = np.linalg.inv(chebyshev.chebvander(at, nodes - 1))
        both = [np.einsum("ia,jb,abrc->ijrc", back, back, grid) for grid in (np.linalg.pinv(w), w)]
        worst = 0.0
        for x, y in places:
            tx, ty = chebyshev.chebvander([x], nodes - 1)[0], chebyshev.chebvander([y], nodes - 1)[0]
            pinv = np.einsum("i,j,ijrc->rc", ty, tx, both[0])
            true = np.linalg.pinv(matrix_at(x, y))
            worst = max(worst, float(np.max(np.abs(pinv - true)) / np.max(np.abs(true))))
        if worst < TOLERANCE:
            stacks = [np.ascontiguousarray(b.reshape(-1, b.shape[-1]), dtype=np.float32) for b in both]
            return nodes, stacks[0], stacks[1]
    raise NotDetermined(
        f"the instrument's field_retardance changes W so fast that {NODES[-1]} nodes a side leave an error of "
        f"{worst:.1g}; check its coefficients."
    )
