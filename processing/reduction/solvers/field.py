"""Inversion where W differs from pixel to pixel: a retardance that varies smoothly over the image."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.computing.threads import for_ranges
from processing.reduction.solvers.field_matrix import FieldMatrix
from processing.reduction.solvers.plain import MuellerSolver
from processing.storage.products.pixel_mask import Mask

#: Pixels solved at a time, about: whole rows of the image.
TILE = 2048


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
    """Least squares with W of each pixel's place.

    Values and residual are those of the place. Standard errors are those of the image's centre: they change with the
    place far less than the values do. Saturated and struck intensities are not left out; their pixels are not
    determined.

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
        self.dark_errors, self.black_variance = plain.dark_errors, plain.black_variance
        self.field = field
        what = "the instrument's field_retardance changes W"
        self._pinv = FieldMatrix.of(lambda y, x: np.asarray(np.linalg.pinv(self._w_at(y, x)), dtype=float), what)
        self._w = FieldMatrix.of(self._w_at, what)

    def _w_at(self, y: float, x: float) -> NDArray[np.float64]:
        return self.field.matrix(self.field.extra(np.array([x]), np.array([y]))[:, 0])

    def mueller(self, signal: NDArray[np.float32], first: int, stop: int) -> NDArray[np.float32]:
        """Mueller elements (16, pixels) of signal (N, pixels), which are rows first..stop of the image."""
        return self._pinv.times(self._pinv.weights(*self._places(first, stop)), signal)

    def _places(self, first: int, stop: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        height, width = self.reader.capture.frame_shape
        return _centred(np.arange(first, stop), height), _centred(np.arange(width), width)

    def matrix(self, start: int, stop: int) -> NDArray[np.float32]:
        """W (N, 16, pixels) of pixels start..stop of the block that the reader just read."""
        width = self.reader.capture.frame_shape[1]
        first, last = start // width, -(-stop // width)
        weights = self._w.weights(*self._places(self.reader.first_row + first, self.reader.first_row + last))
        fixed = self._w.stack.reshape(len(weights), *self.inversion.w.shape)
        inside = weights[:, start - first * width : stop - first * width]
        return np.asarray(np.einsum("knj,kp->njp", fixed, inside))

    def solve(self, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """As `Solver.solve`; pixels with saturated or struck intensities are not determined."""
        found = self.estimate(frames)
        partly = (found["pixel_flags"] & np.uint8(Mask.PARTLY)) != 0
        found["pixel_flags"][partly] |= np.uint8(Mask.NOT_DETERMINED)
        return found

    def estimate(self, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """As `Solver.estimate`."""
        found = self.plain.estimate(frames)
        rows = frames.shape[2] // self.reader.capture.frame_shape[1]
        for_ranges(rows, lambda a, b: self._range(frames, a, b, found), align=1, smallest=16)
        return found

    def _range(self, frames: NDArray[Any], start: int, stop: int, found: dict[str, NDArray[Any]]) -> None:
        n, width = self.inversion.w.shape[0], self.reader.capture.frame_shape[1]
        height = max(1, TILE // width)
        for row in range(start, stop, height):
            last = min(row + height, stop)
            pixels = slice(row * width, last * width)
            first = self.reader.first_row + row
            signal = np.empty((*frames.shape[:2], pixels.stop - pixels.start), np.float32)
            self.reader.signal(frames[:, :, pixels], pixels, signal)
            m = self.mueller(signal.reshape(n, -1), first, first + last - row)
            before = found["residual_rms"][pixels].copy()
            residual = signal.reshape(n, -1)
            residual -= self._w.times(self._w.weights(*self._places(first, first + last - row)), m)
            found["mueller"][:, pixels] = m
            found["residual_rms"][pixels] = np.sqrt(np.einsum("np,np->p", residual, residual) / n)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.where(before > 0, found["residual_rms"][pixels] / before, 1.0)
            found["reduced_chi_square"][pixels] *= ratio**2


def _centred(index: NDArray[np.int64], size: int) -> NDArray[np.float64]:
    return np.asarray(2.0 * index / max(size - 1, 1) - 1.0)
