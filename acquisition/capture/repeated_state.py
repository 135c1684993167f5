"""A light state that repeats the pose of the first one should see the same light.

An encoder that agrees with itself says nothing about an optic that slipped on its shaft, and a lamp has no encoder at
all. Where a plan comes back to its first pose (`repeat_first`), the two frames tell that something has changed, though
not what: `diagnose` tells a slipped element from a lamp that drifts.
"""

import numpy as np
from numpy.typing import NDArray

from processing.computing.filters import block_means

#: Noise is averaged over so many blocks a side, each of so many pixels a side at least; those with less light than this
#: part of the brightest are left out.
BLOCKS, BLOCK_PIXELS = 16, 8
LIT = 0.2
#: Changes that are reported: of all the light, and from block to block (standard deviation).
CHANGED = 0.01
PATTERN = 0.02


class RepeatedState:
    """Compares light frames with the first one, where exposure and pose are the same.

    Parameters
    ----------
    black_level : counts without light, as declared.
    """

    def __init__(self, black_level: float) -> None:
        self._black = black_level
        self._first: tuple[float, ...] | None = None
        self._state = 0
        self._blocks = np.zeros(0)
        # A plan of one pose repeats it with every state: only the first change is reported.
        self._is_reported = False

    def look(self, state: int, exposure_s: float, pose: tuple[float, ...], frame: NDArray[np.generic]) -> str | None:
        """What differs from the first light state, in words; None for any other pose, or if nothing does.

        Parameters
        ----------
        pose : target angles of the state.
        frame : counts (rows, columns).
        """
        key = (exposure_s, *pose)
        if self._first is None:
            self._first, self._state, self._blocks = key, state, self._means(frame)
        if key != self._first or state == self._state or self._is_reported:
            return None
        lit = self._blocks > LIT * max(float(self._blocks.max()), 1.0)
        if not lit.any():
            return None
        blocks = self._means(frame)
        change = float(blocks[lit].sum() / self._blocks[lit].sum()) - 1
        pattern = float(np.std(blocks[lit] / self._blocks[lit]))
        if abs(change) < CHANGED and pattern < PATTERN:
            return None
        self._is_reported = True
        return (
            f"state {state} repeats the pose of state {self._state}, and its light differs by {100 * change:+.1f} %, "
            f"from place to place by {100 * pattern:.1f} %: the lamp drifted, the sample moved, or an optic slipped "
            "although its encoder agrees"
        )

    def _means(self, frame: NDArray[np.generic]) -> NDArray[np.float64]:
        rows, columns = (max(1, min(BLOCKS, size // BLOCK_PIXELS)) for size in frame.shape)
        return block_means(frame, rows, columns) - self._black
