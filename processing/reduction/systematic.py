"""Systematic standard errors of a Mueller image, from what the instrument's diagnosis left uncertain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.instrument.model import InstrumentModel
from processing.reduction.effects_of_capture import CountsCorrection


@dataclass(frozen=True)
class _Direction:
    """One independent direction: M moves by `turn` (16, 16) times M, and by what a correction of the counts adds."""

    turn: Array
    counts: CountsCorrection | None


@dataclass(frozen=True)
class Systematic:
    """All directions of one capture.

    Attributes
    ----------
    w, inverse : (L, 16) measurement matrix and (16, L) its inverse.
    channels : rows of W for each state.
    """

    directions: tuple[_Direction, ...]
    w: Array
    inverse: Array
    channels: int

    @classmethod
    def of(
        cls,
        model: InstrumentModel,
        matrix: Callable[[InstrumentModel], Array],
        counts: Callable[[InstrumentModel], CountsCorrection | None],
        inverse: Array,
    ) -> Systematic | None:
        """Directions of a model; None where it has none.

        Parameters
        ----------
        matrix : makes (states, channels, 16), the measurement matrix of the capture, of a model and its effects.
        counts : makes of them what is corrected in the counts.
        inverse : (16, L) of the measurement matrix.
        """
        w, out = matrix(model), []
        flat = w.reshape(-1, 16)
        for error in model.systematic:
            for effects in error.directions:
                moved = matrix(model.model_copy(update={"effects": (*model.effects, *effects)}))
                bent = counts(model.model_copy(update={"effects": effects}))
                turn = np.linalg.pinv(moved.reshape(-1, 16)) @ flat - np.eye(16)
                out.append(_Direction(turn, bent if bent is not None and bent.response else None))
        return cls(tuple(out), flat, inverse, w.shape[1]) if out else None

    def errors(self, mueller: NDArray[np.float32]) -> NDArray[np.float32]:
        """Standard errors (4, 4, pixels) in counts; those of M/m00 times m00, so that of m00 itself is zero."""
        m = mueller.reshape(16, -1).astype(np.float64)
        variance = np.zeros_like(m)
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = m / m[0]
        for direction in self.directions:
            moved = direction.turn @ m
            if direction.counts is not None:
                signal = (self.w @ m).astype(np.float32).reshape(-1, self.channels, m.shape[1])
                bent = signal.copy()
                direction.counts.apply(bent)
                moved += self.inverse @ (bent - signal).reshape(-1, m.shape[1])
            moved -= relative * moved[0]
            variance += moved**2
        return np.sqrt(variance).astype(np.float32).reshape(4, 4, -1)
