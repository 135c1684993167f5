"""What the search asks of measured data and a model."""

from __future__ import annotations

from typing import Protocol

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.space import Space, Sums


class Problem(Protocol):
    """What the search needs of measured data and a model.

    Attributes
    ----------
    folds : parts that are held out in turn; `holds_out_states` says that the parts are states.
    noise_known : the excess is in units of a known noise.
    spread : see `Moments`.
    far_from_linear : fits to parts of the data are further apart than one Gauss-Newton step can tell.
    """

    folds: int
    noise_known: bool
    holds_out_states: bool
    far_from_linear: bool
    spread: float

    def sums(self, space: Space, values: Array, *, derivatives: bool = True) -> Sums:
        """Excess, and with `derivatives` its half gradient and curvature, of every fold."""
        ...

    def pool(self) -> tuple[Candidate, ...]:
        """Every effect at every place."""
        ...

    def powers(self) -> list[tuple[int, Array]]:
        """Rows that the unknowns leave over, and the power of each component of the signal, for each capture."""
        ...

    def relinearize(self, space: Space, values: Array) -> bool:
        """Take these values as the point that corrections are expanded about; False if one as close is known."""
        ...

    def noise_information(self, space: Space, values: Array) -> Array:
        """Part (K, K) of the curvature that is noise of image derivatives and tells nothing about the values."""
        ...

    def time_noise(self, space: Space, values: Array) -> Array:
        """Variance (K,) of values for each state that errors of the frames' times make; 0 of all others."""
        ...
