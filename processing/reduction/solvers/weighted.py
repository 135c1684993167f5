"""Noise-weighted inversion: every intensity counts as much as its noise allows, with the full covariance of a pixel.

The weights come from the plain fit, not from the noisy counts (those would bias the estimate): variance =
slope * fitted signal + floor. Saturated intensities have weight 0, in the fit that the weights come from as well.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.computing.threads import for_ranges
from processing.errors import ProcessError
from processing.polarization.physical import most_likely
from processing.reduction.noise import NoiseModel
from processing.reduction.solvers.base import Solver
from processing.reduction.solvers.field import FieldSolver
from processing.reduction.solvers.inversion import Inversion
from processing.reduction.solvers.plain import LEAST
from processing.reduction.solvers.weighted_kernels import ELEMENTS, PACKED, solve_range
from processing.storage.products.pixel_mask import Mask

TILE = 2048

#: Row and column of each packed element.
PACKED_ROW, PACKED_COLUMN = np.tril_indices(ELEMENTS)
_DIAGONAL = np.flatnonzero(PACKED_ROW == PACKED_COLUMN)


class _Matrix:
    """W (N, 16) of all pixels, in coordinates whose first axes are what the instrument determines."""

    def __init__(self, inversion: Inversion) -> None:
        self.rank, self.w = inversion.rank, inversion.w.astype(np.float32)
        self._axes = _axes(inversion.basis)
        self._solved_w = self.w if self._axes is None else self.w @ self._axes
        self._wt = np.ascontiguousarray(self._solved_w.T)
        self._pairs = np.ascontiguousarray((self._solved_w[:, PACKED_ROW] * self._solved_w[:, PACKED_COLUMN]).T)

    def of(self, pixels: slice) -> "_Matrix | _LocalMatrix":
        """That of pixels of the block that was just read."""
        return self

    def some(self, pixels: NDArray[np.int64]) -> "_Matrix | _LocalMatrix":
        """That of some of its pixels."""
        return self

    def times(self, elements: NDArray[np.float32]) -> NDArray[np.float32]:
        """Intensities (N, pixels) of elements (16, pixels)."""
        return np.asarray(self.w @ elements)

    def times_solution(self, solution: NDArray[np.float32]) -> NDArray[np.float32]:
        """Intensities of a solution in the coordinates."""
        return np.asarray(self._solved_w @ solution)

    def transposed(self, intensities: NDArray[np.float32]) -> NDArray[np.float32]:
        """Transposed W times intensities (N, pixels)."""
        return np.asarray(self._wt @ intensities)

    def drive(self, channel: int, channels: int, pushed: NDArray[np.float32]) -> NDArray[np.float32]:
        """Transposed W of one channel times intensities (states, pixels) of it."""
        return np.asarray(self._solved_w.reshape(-1, channels, ELEMENTS)[:, channel].T @ pushed)

    def normal(self, weight: NDArray[np.float32]) -> NDArray[np.float32]:
        """Normal matrices (136, pixels); what a partial polarimeter cannot see stands apart."""
        normal = self._pairs @ weight
        normal[_DIAGONAL[self.rank :]] = 1.0
        return np.asarray(normal)

    def in_elements(
        self, solution: NDArray[np.float32], covariance: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Solution (16, pixels) and packed covariance (136, pixels) as elements of M, zero where nothing is seen."""
        if self._axes is None:
            return solution, covariance
        seen = self._axes[:, : self.rank]
        full = _unpacked(covariance)[: self.rank, : self.rank]
        in_elements = np.einsum("ik,klp,jl->ijp", seen, full, seen, optimize=True)
        return seen @ solution[: self.rank], in_elements[PACKED_ROW, PACKED_COLUMN]


class _LocalMatrix:
    """W (N, 16, pixels) of each pixel, of an instrument that determines all elements; methods as those of `_Matrix`."""

    rank = ELEMENTS

    def __init__(self, w: NDArray[np.float32]) -> None:
        self.w = w

    def some(self, pixels: NDArray[np.int64]) -> "_LocalMatrix":
        return _LocalMatrix(self.w[:, :, pixels])

    def times(self, elements: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(np.einsum("njp,jp->np", self.w, elements))

    times_solution = times

    def transposed(self, intensities: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(np.einsum("njp,np->jp", self.w, intensities))

    def drive(self, channel: int, channels: int, pushed: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(np.einsum("njp,np->jp", self.w[channel::channels], pushed))

    def normal(self, weight: NDArray[np.float32]) -> NDArray[np.float32]:
        # One intensity at a time: the products of all of them together would leave the cache.
        normal = np.zeros((PACKED, weight.shape[1]), np.float32)
        for w, one in zip(self.w, weight, strict=True):
            normal += (w * one)[PACKED_ROW] * w[PACKED_COLUMN]
        return normal

    def in_elements(
        self, solution: NDArray[np.float32], covariance: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return solution, covariance


class _FieldMatrix:
    """W that varies over the image, of the block that its solver's reader just read."""

    def __init__(self, solver: FieldSolver) -> None:
        self._solver = solver

    def of(self, pixels: slice) -> _LocalMatrix:
        """That of pixels of the block."""
        return _LocalMatrix(self._solver.matrix(pixels.start, pixels.stop))


class WeightedSolver:
    """Weighted least squares for row blocks, with W of the centre or of each pixel's place.

    Parameters
    ----------
    first : unweighted solver of the same capture; the weights come from its fit, and W with them.
    covariance : also return "mueller_covariance" (136, pixels), lower triangle row by row.
    likelihood : also return "mueller_physical" (16, pixels), the most likely physical Mueller matrix.

    Raises
    ------
    ProcessError : the noise of the camera is not known.
    """

    def __init__(self, first: Solver, covariance: bool = False, likelihood: bool = False) -> None:
        if first.noise is None:
            raise ProcessError(
                "weights need the camera's noise, and this capture does not know its gain. "
                "Give --camera FILE (made by `process camera`), or import with --gain-e-per-count."
            )
        self.first, self.reader, self.inversion = first, first.reader, first.inversion
        self.noise: NoiseModel | None = first.noise
        self.repeats, self.intensity_floor = first.repeats, first.intensity_floor
        self.dark_errors, self.black_variance = first.dark_errors, first.black_variance
        self.covariance, self.likelihood = covariance, likelihood
        self._matrix = _FieldMatrix(first) if isinstance(first, FieldSolver) else _Matrix(first.inversion)
        self._floor = self.intensity_floor.astype(np.float32)[:, None]
        self._slope = (first.noise.slope / self.repeats).astype(np.float32)[:, None]

    def estimate(self, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """As `solve`: what is saturated or struck never counts."""
        return self.solve(frames)

    def solve(self, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Mueller elements, errors, residual, reduced chi-square and mask of frames (N, channels, pixels)."""
        found = self.first.estimate(frames)
        pixels = frames.shape[2]
        if self.covariance:
            found["mueller_covariance"] = np.empty((PACKED, pixels), np.float32)
        if self.likelihood:
            found["mueller_physical"] = np.empty((ELEMENTS, pixels), np.float32)
        for_ranges(pixels, lambda a, b: self._range(frames, a, b, found), align=TILE, smallest=TILE)
        return found

    def _range(self, frames: NDArray[Any], start: int, stop: int, found: dict[str, NDArray[Any]]) -> None:
        n, channels = self.inversion.w.shape[0], frames.shape[1]
        for a in range(start, stop, TILE):
            b = min(a + TILE, stop)
            raw = frames[:, :, a:b]
            signal = np.empty(raw.shape, np.float32)
            gain = self.reader.signal(raw, slice(a, b), signal)
            matrix = self._matrix.of(slice(a, b))
            self._refit_saturated(matrix, raw, signal, found, pixels=slice(a, b))
            fitted = matrix.times(found["mueller"][:, a:b])
            weight = self._weights(raw, slice(a, b), fitted, gain)
            residual = signal.reshape(n, b - a) - fitted
            normal = matrix.normal(weight)
            right = matrix.transposed(weight * residual)
            step, covariance = np.empty((ELEMENTS, b - a), np.float32), np.empty((PACKED, b - a), np.float32)
            solve_range(normal, right, step, covariance, 0, b - a)
            residual -= matrix.times_solution(step)
            kept = (weight > 0).sum(axis=0)
            chi_square = np.einsum("np,np->p", weight, residual**2)
            squares = np.einsum("np,np->p", weight > 0, residual**2)
            rank = self.inversion.rank
            expected = (
                kept
                - rank
                - self.inversion.spent
                + self._add_black(matrix, covariance, weight.reshape(-1, channels, b - a), gain)
            )
            step, covariance = matrix.in_elements(step, covariance)
            found["mueller"][:, a:b] += step
            with np.errstate(divide="ignore", invalid="ignore"):
                found["reduced_chi_square"][a:b] = np.where(kept > rank, chi_square / expected, np.nan)
                found["residual_rms"][a:b] = np.sqrt(squares / kept)
            found["mueller_errors"][:, a:b] = np.sqrt(covariance[_DIAGONAL])
            lost = np.isnan(step[0]) & ((found["pixel_flags"][a:b] & np.uint8(Mask.PARTLY)) != 0)
            found["pixel_flags"][a:b][lost] |= np.uint8(Mask.NOT_DETERMINED)
            if self.covariance:
                found["mueller_covariance"][:, a:b] = covariance
            if self.likelihood:
                found["mueller_physical"][:, a:b] = most_likely(found["mueller"][:, a:b], normal)

    def _weights(
        self, raw: NDArray[Any], pixels: slice, fitted: NDArray[np.float32], gain: NDArray[np.float32] | None
    ) -> NDArray[np.float32]:
        """1 / variance (N, pixels) at the fitted signal; 0 for saturated and struck intensities."""
        if gain is None:
            variance = np.maximum(self._slope * fitted + self._floor, LEAST * self._floor)
        else:
            per_state = np.broadcast_to(gain[None], raw.shape).reshape(fitted.shape)
            floor = self._floor * per_state
            variance = np.maximum(self._slope * fitted + floor, LEAST * floor) * per_state
        weight = 1.0 / variance
        weight[~self.reader.sound(raw, pixels).reshape(weight.shape)] = 0.0
        return np.asarray(weight, dtype=np.float32)

    def _refit_saturated(
        self,
        matrix: _Matrix | _LocalMatrix,
        raw: NDArray[Any],
        signal: NDArray[np.float32],
        found: dict[str, NDArray[Any]],
        *,
        pixels: slice,
    ) -> None:
        """Put the plain fit without saturated intensities into `found`, for the pixels that have any."""
        some = np.flatnonzero(found["pixel_flags"][pixels] & np.uint8(Mask.PARTLY))
        if not some.size:
            return
        n, matrix = len(self.inversion.w), matrix.some(some)
        keep = self.reader.sound(raw[:, :, some], pixels.start + some).reshape(n, -1).astype(np.float32)
        right = matrix.transposed(keep * signal[:, :, some].reshape(n, -1))
        fit, covariance = np.empty((ELEMENTS, some.size), np.float32), np.empty((PACKED, some.size), np.float32)
        solve_range(matrix.normal(keep), right, fit, covariance, 0, some.size)
        fit, _ = matrix.in_elements(fit, covariance)
        found["mueller"][:, pixels.start + some] = np.where(np.isnan(fit), 0.0, fit)

    def _add_black(
        self,
        matrix: _Matrix | _LocalMatrix,
        covariance: NDArray[np.float32],
        weight: NDArray[np.float32],
        gain: NDArray[np.float32] | None,
    ) -> NDArray[np.float32] | float:
        """Add what the error of the darks, common to all states of an exposure of a channel, does to M.

        Returns what it adds to the expected weighted sum of squared residuals (pixels,).
        """
        if not self.black_variance.any():
            return 0.0
        channels, pixels = weight.shape[1:]
        full = _unpacked(covariance)
        left = np.zeros(pixels, np.float32)
        for channel in range(channels):
            scale = 1.0 if gain is None else gain[channel]
            for share, variance in zip(self.reader.black_weights.T, self.black_variance, strict=True):
                pushed = share.astype(np.float32)[:, None] * weight[:, channel]
                drive = matrix.drive(channel, channels, pushed)
                moved = np.einsum("ijp,jp->ip", full, drive)
                unit = np.float32(variance) * scale**2
                covariance += unit * moved[PACKED_ROW] * moved[PACKED_COLUMN]
                left += unit * (share.astype(np.float32) @ pushed - np.einsum("ip,ip->p", drive, moved))
        return left


def _axes(basis: NDArray[np.float64]) -> NDArray[np.float32] | None:
    """Orthonormal (16, 16) whose first columns are the basis (16, rank); None where that is everything."""
    rank = basis.shape[1]
    if rank == ELEMENTS:
        return None
    rest = np.linalg.svd(basis, full_matrices=True)[0][:, rank:]
    return np.concatenate([basis, rest], axis=1).astype(np.float32)


def _unpacked(covariance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Full symmetric matrices (16, 16, pixels) of packed ones."""
    full = np.empty((ELEMENTS, ELEMENTS, covariance.shape[1]), np.float32)
    full[PACKED_ROW, PACKED_COLUMN] = covariance
    full[PACKED_COLUMN, PACKED_ROW] = covariance
    return full
