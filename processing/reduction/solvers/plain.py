"""Solve row blocks for Mueller elements with their standard errors and the residual, in one matrix product a tile."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.computing.threads import for_ranges
from processing.reduction.counts_to_signal import BlockReader
from processing.reduction.noise import NoiseModel
from processing.reduction.solvers.inversion import TILE, Inversion
from processing.storage.products.pixel_mask import Mask

#: Pixels of which some intensities are left out, solved at a time, each with its own matrix.
REPAIR_BATCH = 4096
#: A pixel's remaining states must leave W a condition number below this.
WORST_CONDITION = 1e3
#: In the dark the signal is noise about 0: a variance may come out below that of no light, down to this part of it.
LEAST = 0.5


class MuellerSolver:
    """What is the same for all row blocks: the stacked matrix that one product with a tile needs.

    Its rows: pseudo-inverse (16), residual (N - rank), and, with a noise model, squares of the pseudo-inverse (16) and
    of the residual rows, summed (1): applied to the signal these give the variances that shot noise makes.
    """

    def __init__(self, inversion: Inversion, reader: BlockReader, noise: NoiseModel | None) -> None:
        self.inversion, self.reader, self.noise = inversion, reader, noise
        channels = reader.capture.channels
        squares = np.concatenate([inversion.pinv**2, np.sum(inversion.null**2, axis=0, keepdims=True)])
        self.repeats = np.repeat(reader.repeats, channels)
        stack = [inversion.pinv, inversion.null, *([squares / self.repeats] if noise else [])]
        self.stack = np.concatenate(stack).astype(np.float32)
        self.first_square = len(inversion.pinv) + len(inversion.null)
        black = reader.correction.black
        # Residuals tell the noise of light; what darks have they tell themselves.
        camera = noise if noise is not None and noise.residual_share is None else None
        excess = np.repeat(black.excess(camera, reader.exposure_s), channels)
        #: Variance without light of each intensity (N,), counts^2.
        self.intensity_floor = (
            noise.floor_of_rows(self.repeats, excess, channels) if noise else np.zeros(inversion.w.shape[0])
        )
        self.floor = (squares * self.intensity_floor).reshape(17, -1, channels).sum(axis=1).astype(np.float32)
        # The black is the same in all states of one exposure of a channel, so its error is common to them.
        self.black_variance = black.mean_variance(camera)
        seen = np.concatenate([inversion.pinv, inversion.null]).reshape(-1, len(reader.repeats), channels)
        pushed = np.einsum("knc,nd->kcd", seen, reader.black_weights) * np.sqrt(self.black_variance)
        #: Errors (16, means of darks) of the elements, counts, that one standard error of each mean of darks makes.
        self.dark_errors = pushed[:16].reshape(16, -1)
        drive = np.square(pushed).sum(axis=2)
        self.black = np.concatenate([drive[:16], drive[16:].sum(axis=0, keepdims=True)]).astype(np.float32)

    def solve(self, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Mueller elements, errors, residual and mask of frames (N, channels, pixels) that the reader just read."""
        found = self.estimate(frames)
        repair = np.flatnonzero(found["pixel_flags"] & np.uint8(Mask.PARTLY))
        if repair.size:
            solve_with_the_sound(self, frames, repair, found)
        return found

    def estimate(self, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """As `solve`, with saturated and struck intensities taken as they are (but flagged)."""
        pixels = frames.shape[2]
        out: dict[str, NDArray[Any]] = {
            "mueller": np.empty((16, pixels), np.float32),
            "mueller_errors": np.empty((16, pixels), np.float32),
            "residual_rms": np.empty(pixels, np.float32),
            "pixel_flags": np.zeros(pixels, np.uint8),
            "reduced_chi_square": np.full(pixels, np.nan, np.float32),
        }
        for_ranges(pixels, lambda a, b: self._range(frames, a, b, out), align=TILE, smallest=TILE)
        return out

    def _range(self, frames: NDArray[Any], start: int, stop: int, out: dict[str, NDArray[Any]]) -> None:
        n, dof, free = self.inversion.w.shape[0], self.inversion.degrees_of_freedom, self.inversion.free
        square = self.first_square
        tile = np.empty((*frames.shape[:2], TILE), np.float32)
        product = np.empty((len(self.stack), TILE), np.float32)
        for a in range(start, stop, TILE):
            b = min(a + TILE, stop)
            part, result = tile[..., : b - a], product[:, : b - a]
            gain = self.reader.load(frames, a, b, part, mask=out["pixel_flags"])
            np.matmul(self.stack, part.reshape(n, b - a), out=result)
            out["mueller"][:, a:b] = result[:16]
            rss = np.einsum("np,np->p", result[16:square], result[16:square])
            out["residual_rms"][a:b] = np.sqrt(rss / n)
            if self.noise is None:
                out["mueller_errors"][:, a:b] = np.nan
                continue
            variance = self._variance(part, gain, result[square:], self.noise)
            np.sqrt(variance[:16], out=out["mueller_errors"][:, a:b])
            if dof:
                out["reduced_chi_square"][a:b] = rss / variance[16] * (dof / free)

    def _variance(
        self,
        signal: NDArray[np.float32],
        gain: NDArray[np.float32] | None,
        shot: NDArray[np.float32],
        noise: NoiseModel,
    ) -> NDArray[np.float32]:
        """Variances (17, pixels), counts^2: of the 16 elements, and of the whole residual."""
        constant = self.floor + self.black
        if gain is None:
            shot *= np.float32(noise.slope)
            shot += constant.sum(axis=1, keepdims=True)
            return np.asarray(np.maximum(shot, LEAST * constant.sum(axis=1, keepdims=True), out=shot))
        # Divided by the flat, signal and noise scale together: shot variance with the gain, the rest with its square.
        np.matmul(self.stack[self.first_square :], (signal * gain).reshape(self.inversion.w.shape[0], -1), out=shot)
        dark = constant.astype(np.float32) @ gain**2
        return np.asarray(np.maximum(noise.slope * shot + dark, LEAST * dark))


def solve_with_the_sound(
    solver: MuellerSolver, frames: NDArray[Any], pixels: NDArray[np.int64], found: dict[str, NDArray[Any]]
) -> None:
    """Solve pixels again, each from its intensities that are neither saturated nor struck; results go into `found`.

    A pixel whose remaining states are too few is flagged Mask.NOT_DETERMINED.
    """
    basis = solver.inversion.basis
    w = solver.inversion.w @ basis
    n, rank = w.shape
    for part in np.array_split(pixels, -(-len(pixels) // REPAIR_BATCH)):
        raw = frames[:, :, part]
        signal = np.empty(raw.shape, np.float32)
        gain = solver.reader.signal(raw, part, signal)
        keep = solver.reader.sound(raw, part).reshape(n, -1).T.astype(float)
        normal = np.einsum("pn,ni,nj->pij", keep, w, w, optimize=True)
        eigenvalues = np.linalg.eigvalsh(normal)
        # Of a pixel that is cut off in every state nothing is left: all eigenvalues are 0.
        ill = eigenvalues[:, 0] <= WORST_CONDITION**-2 * eigenvalues[:, -1]
        normal[ill] = np.eye(rank)
        solve = basis @ np.linalg.solve(normal, w.T * keep[:, None, :])
        y = signal.reshape(n, -1).T.astype(float)
        m = np.einsum("pin,pn->pi", solve, y)
        residual = (y - m @ solver.inversion.w.T) * keep
        free = np.maximum(keep.sum(axis=1) - rank - solver.inversion.spent, 0)
        rss = np.sum(residual**2, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = np.ones((frames.shape[1], len(part)), np.float32) if gain is None else gain
            scale = np.asarray(np.broadcast_to(unit[None], raw.shape).reshape(n, -1).T, dtype=float)
            variance, expected = _expected(solver, solve, keep, y, scale=scale)
            if solver.noise is None:
                variance[:] = np.nan
            else:
                found["reduced_chi_square"][part] = np.where(free > 0, rss / expected, np.nan)
            found["mueller_errors"][:, part] = np.sqrt(variance)
        found["mueller"][:, part] = m.T
        found["residual_rms"][part] = np.sqrt(rss / np.maximum(keep.sum(axis=1), 1))
        found["pixel_flags"][part[ill]] |= np.uint8(Mask.NOT_DETERMINED)


def _expected(
    solver: MuellerSolver,
    solve: NDArray[np.float64],
    keep: NDArray[np.float64],
    y: NDArray[np.float64],
    *,
    scale: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Variances (16, pixels) and expected sum of squared residuals (pixels,) of fits to the states kept.

    solve (pixels, 16, N) is each pixel's least-squares matrix, 0 where a state is left out; y and keep (pixels, N);
    scale (pixels, N) is 1 / flat. The residual of least squares is a projection, so noise of variance v leaves the
    sum over the states of v times its diagonal.
    """
    w, n = solver.inversion.w, solver.inversion.w.shape[0]
    slope = solver.noise.slope / solver.repeats if solver.noise else np.zeros(n)
    dark = solver.intensity_floor * scale**2
    diagonal = keep - np.einsum("ni,pin->pn", w, solve)

    def total(variance: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([*np.einsum("pin,pn->ip", solve**2, variance), np.einsum("pn,pn->p", diagonal, variance)])

    least = total(dark)
    channels = solver.black.shape[1]
    for channel in range(channels):
        for weight, variance in zip(solver.reader.black_weights.T, solver.black_variance, strict=True):
            common = np.zeros(n)
            common[channel::channels] = weight
            pushed = common * scale * keep
            moved = np.einsum("pin,pn->pi", solve, pushed)
            left = (pushed - moved @ w.T) * keep
            least += variance * np.stack([*moved.T**2, np.sum(left**2, axis=1)])
    found = np.maximum(total(slope * y * scale) + least, LEAST * least)
    return found[:16], found[16]
