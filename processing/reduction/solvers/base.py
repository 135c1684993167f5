"""What every solver of Mueller matrices offers; solvers build on each other: W of the centre, of the place, weights."""

from typing import Any, Protocol

from numpy.typing import NDArray

from processing.arrays import Array
from processing.reduction.counts_to_signal import BlockReader
from processing.reduction.noise import NoiseModel
from processing.reduction.solvers.inversion import Inversion


class Solver(Protocol):
    """Solves row blocks of a capture; N is the number of states times channels.

    Attributes
    ----------
    inversion : of W at the image's centre.
    reader : of the row blocks.
    noise : of a frame; None where the noise is estimated from the residual.
    repeats : (N,) frames averaged in each intensity.
    intensity_floor : (N,) variance without light, counts^2.
    dark_errors : (16, D) errors of the elements, counts, by one standard error of each mean of dark frames.
    black_variance : (D,) of each mean of dark frames, counts^2.
    """

    inversion: Inversion
    reader: BlockReader
    noise: NoiseModel | None
    repeats: Array
    intensity_floor: Array
    dark_errors: Array
    black_variance: Array

    def solve(self, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Elements, errors, residual, chi-square and flags of frames (states, channels, pixels) just read.

        The keys are names of planes: "mueller" and "mueller_errors" (16, pixels), "residual_rms",
        "reduced_chi_square" and "pixel_flags" (pixels,), and what a solver adds.
        """
        ...

    def estimate(self, frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """As `solve`, with saturated and struck intensities taken as they are (but flagged)."""
        ...
