"""Least-squares inversion of intensities into Mueller elements, one matrix for all pixels.

The data are planes: frames (N, pixels) of any real type, result (16, pixels) float32. A tile of pixels is
converted to float32 and multiplied by BLAS while it is in the cache; tiles are spread over Python threads. BLAS
itself must run one thread (`one_blas_thread`), or its threads and ours fight for the cores.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.computing.threads import for_ranges
from processing.errors import NotDetermined
from processing.instrument.model import rank

#: Pixels in a tile: 40 float32 rows of it stay in a core's second-level cache.
TILE = 4096

ELEMENTS = 16


@dataclass(frozen=True)
class Inversion:
    """Pseudo-inverse of W and what belongs to it.

    Attributes
    ----------
    w : (N, K) measurement matrix, K = 16 for Mueller, 3 for linear Stokes.
    pinv : (K, N) pseudo-inverse.
    null : (N - R, N) orthonormal rows that see only what W cannot explain: the residual, without forming the fit.
    condition_number : largest over smallest singular value, of what is determined.
    basis : (K, R) what the instrument can determine; R = K unless it is a partial polarimeter.
    spent : numbers that all pixels together were fitted with (levels of the source), over the pixels.
    """

    w: NDArray[np.float64]
    pinv: NDArray[np.float64]
    null: NDArray[np.float64]
    condition_number: float
    basis: NDArray[np.float64]
    spent: float = 0.0

    @classmethod
    def of(
        cls, w: NDArray[np.float64], what: str = "", basis: NDArray[np.float64] | None = None, spent: float = 0.0
    ) -> "Inversion":
        """Invert a measurement matrix (N, 16); `basis` (16, R) is what the instrument can determine, default all.

        Raises NotDetermined: W has a rank below R; the message names the rank and the elements of M that the states
        cannot see.
        """
        basis = np.eye(w.shape[1]) if basis is None else basis
        seen = w @ basis
        found = rank(w)
        if found < basis.shape[1]:
            raise NotDetermined(_missing(w, found, basis, what))
        u, size, _ = np.linalg.svd(seen, full_matrices=True)
        pinv = basis @ np.linalg.pinv(seen)
        null = np.array(u[:, basis.shape[1] :].T, dtype=float)
        return cls(w, np.asarray(pinv, dtype=float), null, float(size[0] / size[-1]), basis, spent)

    @property
    def rank(self) -> int:
        """Numbers that are determined."""
        return int(self.basis.shape[1])

    @property
    def degrees_of_freedom(self) -> int:
        """States minus unknowns."""
        return int(self.null.shape[0])

    @property
    def free(self) -> float:
        """Degrees of freedom of the residual of a pixel."""
        return self.degrees_of_freedom - self.spent


def multiply_tiles(
    matrix: NDArray[np.float32],
    frames: NDArray[np.generic],
    out: NDArray[np.float32],
    offset: NDArray[np.float32] | float = 0.0,
) -> None:
    """out = matrix @ (frames - offset), tile by tile on all cores.

    Parameters
    ----------
    matrix : (K, N) float32.
    frames : (N, pixels), any real type.
    out : (K, pixels) float32, overwritten; reuse it, because first touch of new memory is slow.
    offset : a number, or (pixels,) in counts, subtracted from every frame.
    """
    states, pixels = frames.shape

    def loop(start: int, stop: int) -> None:
        tile = np.empty((states, TILE), dtype=np.float32)
        for a in range(start, stop, TILE):
            b = min(a + TILE, stop)
            part = tile[:, : b - a]
            np.copyto(part, frames[:, a:b], casting="unsafe")
            if isinstance(offset, np.ndarray):
                part -= offset[a:b]
            elif offset:
                part -= np.float32(offset)
            np.matmul(matrix, part, out=out[:, a:b])

    for_ranges(pixels, loop, align=TILE, smallest=TILE)


def mueller_planes(
    inversion: Inversion,
    frames: NDArray[np.generic],
    out: NDArray[np.float32] | None = None,
    offset: NDArray[np.float32] | float = 0.0,
) -> NDArray[np.float32]:
    """Mueller elements (16, pixels) float32 of frames (N, pixels); `offset` is the black in counts."""
    if out is None:
        out = np.empty((inversion.pinv.shape[0], frames.shape[1]), dtype=np.float32)
    multiply_tiles(inversion.pinv.astype(np.float32), frames, out, offset)
    return out


def _missing(w: NDArray[np.float64], found: int, basis: NDArray[np.float64], what: str) -> str:
    # An element of M is not determined if its unit vector leaves the row space of W.
    _, _, vt = np.linalg.svd(w, full_matrices=False)
    row_space = vt[:found]
    outside = 1.0 - np.sum(row_space**2, axis=0)
    could = np.sum(np.linalg.qr(basis)[0] ** 2, axis=1) > 1 - 1e-6
    lost = ", ".join(f"m{k // 4}{k % 4}" for k in np.flatnonzero((outside > 1e-6) & could))
    need = basis.shape[1]
    advice = "an analyzer ratio of 4.91 with 40 states gives rank 16, a ratio of exactly 5 only 12"
    return (
        f"{what}the measurement matrix W has rank {found}, and {need} are needed: {w.shape[0]} intensities a pixel "
        f"do not determine {lost or 'what the instrument can'} (each alone or in combination). Take states at more, or "
        f"at less regular, angles{': ' + advice if need == basis.shape[0] else ''}."
    )
