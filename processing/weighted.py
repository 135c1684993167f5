"""Noise-weighted inversion: every intensity counts as much as its noise allows, with the full covariance of a pixel.

The weights come from the plain fit, not from the noisy counts (those would bias the estimate): variance =
slope * fitted signal + floor. Saturated intensities have weight 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.correction import Mask
from processing.errors import ProcessError
from processing.mueller_solver import LEAST, MuellerSolver
from processing.noise import NoiseModel
from processing.physical import most_likely
from processing.threads import for_ranges
from processing.weighted_kernels import ELEMENTS, PACKED, solve_range

TILE = 2048

#: Row and column of each packed element.
PACKED_ROW, PACKED_COLUMN = np.tril_indices(ELEMENTS)
_DIAGONAL = np.flatnonzero(PACKED_ROW == PACKED_COLUMN)


class WeightedSolver:
    """Weighted least squares for row blocks; the same interface as MuellerSolver.

    Parameters
    ----------
    plain : the unweighted solver of the same capture.
    covariance : also return "mueller_covariance" (136, pixels), lower triangle row by row.
    likelihood : also return "mueller_physical" (16, pixels), the most likely physical Mueller matrix.

    Raises
    ------
    ProcessError : the noise of the camera is not known.
    """

    def __init__(self, plain: MuellerSolver, covariance: bool = False, likelihood: bool = False) -> None:
        if plain.noise is None:
            raise ProcessError(
                "weights need the camera's noise, and this capture does not know its gain. "
                "Give --camera FILE (made by `process camera`), or import with --gain-e-per-count."
            )
        self.plain, self.reader, self.inversion = plain, plain.reader, plain.inversion
        self.noise: NoiseModel = plain.noise
        self.repeats = plain.repeats
        self.covariance, self.likelihood = covariance, likelihood
        w = plain.inversion.w.astype(np.float32)
        self._w, self._wt = w, np.ascontiguousarray(w.T)
        self._pairs = np.ascontiguousarray((w[:, PACKED_ROW] * w[:, PACKED_COLUMN]).T)
        self._floor = self.noise.averaged_floor(self.repeats).astype(np.float32)[:, None]
        self._slope = (self.noise.slope / self.repeats).astype(np.float32)[:, None]

    def solve(self, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Mueller elements, errors, residual, reduced chi-square and mask of frames (N, channels, pixels)."""
        found = self.plain.estimate(frames)
        pixels = frames.shape[2]
        if self.covariance:
            found["mueller_covariance"] = np.empty((PACKED, pixels), np.float32)
        if self.likelihood:
            found["mueller_physical"] = np.empty((ELEMENTS, pixels), np.float32)
        for_ranges(pixels, lambda a, b: self._range(frames, a, b, found), align=TILE, smallest=TILE)
        return found

    def _range(self, frames: NDArray[Any], start: int, stop: int, found: dict[str, NDArray[Any]]) -> None:
        n, channels = self._w.shape[0], frames.shape[1]
        for a in range(start, stop, TILE):
            b = min(a + TILE, stop)
            raw = frames[:, :, a:b]
            signal = np.empty(raw.shape, np.float32)
            gain = self.reader.signal(raw, slice(a, b), signal)
            weight = self._weights(raw, found["mueller"][:, a:b], gain)
            residual = signal.reshape(n, b - a) - self._w @ found["mueller"][:, a:b]
            normal = self._pairs @ weight
            right = self._wt @ (weight * residual)
            step, covariance = np.empty((ELEMENTS, b - a), np.float32), np.empty((PACKED, b - a), np.float32)
            solve_range(normal, right, step, covariance, 0, b - a)
            residual -= self._w @ step
            kept = (weight > 0).sum(axis=0)
            chi_square = np.einsum("np,np->p", weight, residual**2)
            squares = np.einsum("np,np->p", weight > 0, residual**2)
            with np.errstate(divide="ignore", invalid="ignore"):
                found["reduced_chi_square"][a:b] = np.where(kept > ELEMENTS, chi_square / (kept - ELEMENTS), np.nan)
                found["residual_rms"][a:b] = np.sqrt(squares / kept)
            found["mueller"][:, a:b] += step
            self._add_black(covariance, weight.reshape(-1, channels, b - a), gain)
            found["mueller_errors"][:, a:b] = np.sqrt(covariance[_DIAGONAL])
            lost = np.isnan(step[0]) & ((found["pixel_mask"][a:b] & np.uint8(Mask.SATURATED)) != 0)
            found["pixel_mask"][a:b][lost] |= np.uint8(Mask.NOT_DETERMINED)
            if self.covariance:
                found["mueller_covariance"][:, a:b] = covariance
            if self.likelihood:
                found["mueller_physical"][:, a:b] = most_likely(found["mueller"][:, a:b], normal)

    def _weights(
        self, raw: NDArray[Any], elements: NDArray[np.float32], gain: NDArray[np.float32] | None
    ) -> NDArray[np.float32]:
        """1 / variance (N, pixels); 0 for saturated intensities."""
        fitted = self._w @ elements
        if gain is None:
            variance = np.maximum(self._slope * fitted + self._floor, LEAST * self._floor)
        else:
            per_state = np.broadcast_to(gain[None], raw.shape).reshape(fitted.shape)
            floor = self._floor * per_state
            variance = np.maximum(self._slope * fitted + floor, LEAST * floor) * per_state
        weight = 1.0 / variance
        level = self.reader.correction.saturation
        if level is not None:
            weight[raw.reshape(weight.shape) >= level] = 0.0
        return np.asarray(weight, dtype=np.float32)

    def _add_black(
        self, covariance: NDArray[np.float32], weight: NDArray[np.float32], gain: NDArray[np.float32] | None
    ) -> None:
        """Add what the error of the dark frames, common to all states of a channel, does to M."""
        variance = self.reader.black_variance(self.noise)
        if variance == 0.0:
            return
        states, channels, pixels = weight.shape
        w = self._w.reshape(states, channels, ELEMENTS)
        full = np.empty((ELEMENTS, ELEMENTS, pixels), np.float32)
        full[PACKED_ROW, PACKED_COLUMN] = covariance
        full[PACKED_COLUMN, PACKED_ROW] = covariance
        for channel in range(channels):
            drive = w[:, channel].T @ weight[:, channel]
            moved = np.einsum("ijp,jp->ip", full, drive)
            if gain is not None:
                moved *= gain[channel]
            covariance += np.float32(variance) * moved[PACKED_ROW] * moved[PACKED_COLUMN]
