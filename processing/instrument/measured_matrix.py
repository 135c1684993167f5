"""A measurement matrix W that was measured as a whole, as the states of an instrument."""

from collections.abc import Iterator, Mapping
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from processing.arrays import Array
from processing.errors import ProcessError
from processing.section import Section

#: The axis that tells states apart which have no angles.
NUMBER = "state"


class MeasuredMatrix(Section):
    """Rows of W at the states where they were measured; a capture is of these states, in any order."""

    angles_deg: dict[str, tuple[float, ...]] = Field(
        default={}, description="angle of each axis in each state, degrees; without it the states have numbers"
    )
    rows: tuple[tuple[float, ...], ...] = Field(
        description="for each state, and in it for each channel: 16 numbers for M row by row, or 4 for S"
    )
    u: float = Field(default=0.0, ge=0, description="standard uncertainty of every number of W")
    tolerance_deg: float = Field(
        default=0.1, gt=0, description="most that a state is away, degrees; for an axis of volts give a smaller number"
    )

    @model_validator(mode="before")
    @classmethod
    def _number(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and not data.get("angles_deg") and isinstance(data.get("rows"), list | tuple):
            return {**data, "angles_deg": {NUMBER: tuple(range(len(data["rows"])))}}
        return data

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if not self.rows:
            raise ValueError("rows of W are missing")
        lengths = {len(column) for column in self.angles_deg.values()}
        if len(lengths) != 1 or len(self.rows) % (lengths.pop() or 1):
            raise ValueError("each axis needs one angle a state, and each state one row for each channel")
        if {len(row) for row in self.rows} not in ({4}, {16}):
            raise ValueError("a row has 16 numbers for M, or 4 for S; all rows alike")
        return self

    @property
    def states(self) -> int:
        """How many states were measured."""
        return len(next(iter(self.angles_deg.values())))

    def errors(self) -> Iterator[Self]:
        """W with one standard uncertainty of each independent direction.

        All numbers are wrong independently, and so along any axes. Along the left singular vectors only the first ones,
        as many as the rank, change what W makes of its states; the others are residual.
        """
        w = np.array(self.rows)
        states, sizes, _ = np.linalg.svd(w, full_matrices=False)
        for direction in states.T[sizes > 1e-8 * sizes[0]] if self.u else ():
            for column in range(w.shape[1]):
                moved = w.copy()
                moved[:, column] += self.u * direction
                yield self.model_copy(update={"rows": tuple(map(tuple, moved.tolist()))})

    def at(self, angles_deg: Mapping[str, ArrayLike]) -> Array:
        """Rows (states, channels, 16) of the states with these angles. Raises ProcessError."""
        targets = {axis: np.atleast_1d(np.asarray(angles_deg[axis], dtype=float)) for axis in self.angles_deg}
        off = np.max([np.abs(targets[axis][:, None] - column) for axis, column in self.angles_deg.items()], axis=0)
        nearest = off.argmin(axis=1)
        if np.any(far := ~(off.min(axis=1) <= self.tolerance_deg)):
            state = int(np.flatnonzero(far)[0])
            place = ", ".join(f"{axis} {column[state]:g}" for axis, column in targets.items())
            raise ProcessError(
                f"state {state} has {place}, and W was measured at no such state within "
                f"{self.tolerance_deg:g} degrees (or volts). Take the states of the instrument file, or measure W at "
                "these."
            )
        rows = np.zeros((len(self.rows), 16))
        matrix = np.array(self.rows)
        # A row of a Stokes polarimeter acts on the first column of M.
        rows[:, :: 16 // matrix.shape[1]] = matrix
        return np.asarray(rows.reshape(self.states, -1, 16)[nearest])
