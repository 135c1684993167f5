"""Polarimeters that light the sample in one state: no element of M is determined alone, but the light sent back is.

Every row of W is kron(a, g) with the same g, so intensities are a . (M g): the Stokes vector that the sample sends back
for this light. For unpolarized light it is the first column of M, and elements are determined after all.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array, BoolArray
from processing.instrument.determined_basis import ALIKE, determined_elements
from processing.reduction.solvers.base import Solver
from processing.reduction.solvers.inversion import Inversion
from processing.reduction.solvers.plain import LEAST
from processing.storage.products.product import Plane

PLANES = {
    "stokes": Plane((4,), "count", "Stokes vector S0 to S3 that the sample sends back for the light that it gets"),
    "stokes_errors": Plane((4,), "count", "standard errors of stokes"),
}


def light_of(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Stokes vector (4,) of the light on the sample, of intensity 1, where it is one for all rows of W (N, 16)."""
    light = np.linalg.svd(w.reshape(-1, 4), full_matrices=False)[2][0]
    return np.asarray(light / light[0], dtype=float)


def sent_rows(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows (4, 16) that lead from M to the Stokes vector sent back, for a light of intensity 1, of W (N, 16)."""
    return np.asarray(np.kron(np.eye(4), light_of(w)), dtype=float)


def sent_parts(sent: NDArray[np.floating]) -> BoolArray:
    """Which of S0 to S3 of an image (4, rows, columns) of the light sent back are determined, (4,)."""
    return np.asarray(np.isfinite(sent).any(axis=(1, 2)))


@dataclass(frozen=True)
class SentLight:
    """Stokes vector of the light that the sample sends back.

    Attributes
    ----------
    rows : (4, 16), S = rows . vec(M), for a light of intensity 1.
    is_determined : (4,), which of S0 to S3 the states determine.
    """

    rows: NDArray[np.float64]
    is_determined: BoolArray

    @classmethod
    def of(cls, inversion: Inversion) -> Self | None:
        """None where the generator turns, or where elements of M are determined by themselves."""
        if determined_elements(inversion.basis).any():
            return None
        size = np.linalg.svd(inversion.w.reshape(-1, 4), compute_uv=False)
        if size[1] > ALIKE * size[0]:
            return None
        rows = sent_rows(inversion.w)
        inside = np.sum((rows @ inversion.basis) ** 2, axis=1) > (1 - 1e-9) * np.sum(rows**2, axis=1)
        return cls(rows, inside)

    @property
    def named(self) -> str:
        """What is determined, in words."""
        names = ", ".join(f"S{k}" for k in np.flatnonzero(self.is_determined))
        return f"{names} of the light that the sample sends back (dataset stokes)"

    def planes(self, mueller: Array, variance_ratio: Array | float, solver: Solver) -> dict[str, Any]:
        """Datasets `PLANES` (4, pixels) from the solution of least norm (16, pixels), in counts.

        `variance_ratio` (pixels,) or 1: variance of the noise over that of the solver's noise model.
        """
        inversion = solver.inversion
        stokes = (self.rows @ mueller).astype(np.float32)
        floor = solver.intensity_floor[:, None]
        slope = np.nan if solver.noise is None else solver.noise.slope
        variance = np.maximum((slope / solver.repeats)[:, None] * (inversion.w @ mueller) + floor, LEAST * floor)
        solve = self.rows @ inversion.pinv
        channels = solver.reader.capture.channels
        drive = np.einsum("knc,nd->kcd", solve.reshape(4, -1, channels), solver.reader.black_weights) ** 2
        dark = (drive @ solver.black_variance).sum(axis=1)
        errors = np.sqrt(solve**2 @ variance * variance_ratio + dark[:, None]).astype(np.float32)
        stokes[~self.is_determined], errors[~self.is_determined] = np.nan, np.nan
        return {"stokes": stokes, "stokes_errors": errors}
