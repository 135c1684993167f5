"""State tables: which angles, exposure and role each state of a measurement has."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Role = Literal["dark", "flat", "air", "sample"]

#: RGB950's own table (docs/conventions.md, "Instrument"): tG = 9 n degrees, tA = 4.91 tG.
RGB950_STATES = 40
RGB950_STEP_DEG = 9.0
RGB950_RATIO = 4.91


@dataclass(frozen=True)
class StateTable:
    """Immutable rows of a measurement.

    Attributes
    ----------
    angles_deg
        Mapping of axis name to array (N,), target angles in degrees.
    exposure_s : array (N,), seconds.
    role : tuple of N roles.
    repeats : array (N,), frames averaged for the state.

    Examples
    --------
    >>> import numpy as np
    >>> psg = np.arange(0, 27, 9.0)
    >>> table = StateTable.of_angles({"psg": psg, "psa": 5 * psg}, exposure_s=0.02)
    >>> table.role, table.angles_deg["psa"].tolist()
    (('sample', 'sample', 'sample'), [0.0, 45.0, 90.0])
    """

    angles_deg: Mapping[str, NDArray[np.float64]]
    exposure_s: NDArray[np.float64]
    role: tuple[Role, ...]
    repeats: NDArray[np.int64]

    def __post_init__(self) -> None:
        n = len(self.role)
        for name, column in {**self.angles_deg, "exposure_s": self.exposure_s, "repeats": self.repeats}.items():
            if np.shape(column) != (n,):
                raise ValueError(f"state table: column {name!r} has shape {np.shape(column)}, expected ({n},)")
            if not np.all(np.isfinite(column)):
                raise ValueError(f"state table: column {name!r} has a value that is not a finite number")

    def __len__(self) -> int:
        return len(self.role)

    @classmethod
    def of_angles(cls, angles_deg: Mapping[str, NDArray[np.float64]], exposure_s: float = 1.0) -> "StateTable":
        """Sample states of one exposure at these angles, axis name to (N,)."""
        n = len(next(iter(angles_deg.values())))
        sample: Role = "sample"
        return cls(angles_deg, np.full(n, float(exposure_s)), (sample,) * n, np.ones(n, dtype=np.int64))


def rotating_retarders(
    exposure_s: float,
    states: int = RGB950_STATES,
    step_deg: float = RGB950_STEP_DEG,
    ratio: float = RGB950_RATIO,
    *,
    repeats: int = 1,
    axes: tuple[str, str] = ("psg", "psa"),
) -> StateTable:
    """Sample states at equal steps of the generator's axis, the analyzer's turning `ratio` times as far.

    Parameters
    ----------
    exposure_s : float
        Of every state, seconds.
    states : int
    step_deg : float
        Between two states of the first axis, which begins at 0 degrees; the defaults are RGB950's table.
    ratio : float
        Turn of the second axis over that of the first.
    repeats : int
        Frames averaged for each state.
    axes : tuple of str
        Names of the generator's and the analyzer's axis.

    Returns
    -------
    StateTable

    Examples
    --------
    >>> table = rotating_retarders(0.02, states=3, ratio=5)
    >>> table.angles_deg["psg"].tolist(), table.angles_deg["psa"].tolist()
    ([0.0, 9.0, 18.0], [0.0, 45.0, 90.0])
    """
    sample: Role = "sample"
    psg = step_deg * np.arange(states, dtype=float)
    return StateTable(
        angles_deg={axes[0]: psg, axes[1]: ratio * psg},
        exposure_s=np.full(states, float(exposure_s)),
        role=(sample,) * states,
        repeats=np.full(states, repeats, dtype=np.int64),
    )
