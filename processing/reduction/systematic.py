"""Systematic standard errors of a Mueller or Stokes image, from what the instrument's diagnosis left uncertain."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.instrument.model import InstrumentModel
from processing.reduction.effects_of_capture import CountsCorrection


@dataclass(frozen=True)
class Direction:
    """One independent direction of one standard deviation.

    Attributes
    ----------
    turn : (K, K); the unknowns of a pixel move by `turn` times themselves.
    counts : a correction of the counts that moves them further; None without.
    """

    turn: Array
    counts: CountsCorrection | None


@dataclass(frozen=True)
class Systematic:
    """All directions of one capture, for K unknowns of a pixel: 16 of a Mueller matrix, 3 of a linear Stokes vector.

    Attributes
    ----------
    w, inverse : (L, K) measurement matrix and (K, L) its inverse in what the instrument determines.
    channels : rows of `w` for each state.
    """

    directions: tuple[Direction, ...]
    w: Array
    inverse: Array
    channels: int

    @classmethod
    def of(
        cls,
        model: InstrumentModel,
        matrix: Callable[[InstrumentModel], Array],
        counts: Callable[[InstrumentModel], CountsCorrection | None],
        basis: Array,
    ) -> Systematic | None:
        """Directions of a model; None where it has none.

        Parameters
        ----------
        matrix : makes (states, channels, K), the measurement matrix of the capture, of a model and its effects.
        counts : makes of them what is corrected in the counts.
        basis : (K, R) what the instrument determines of the unknowns; they move inside of that alone.
        """

        def inverse(w: Array) -> Array:
            return np.asarray(basis @ np.linalg.pinv(w.reshape(-1, len(basis)) @ basis))

        w = matrix(model)
        flat, out = w.reshape(-1, len(basis)), []
        for error in model.systematic:
            for effects in error.directions:
                moved = matrix(model.model_copy(update={"effects": (*model.effects, *effects)}))
                bent = counts(model.model_copy(update={"effects": effects}))
                turn = inverse(moved) @ flat - basis @ basis.T
                out.append(Direction(turn, bent if bent is not None and bent.response else None))
        return cls(tuple(out), flat, inverse(w), w.shape[1]) if out else None

    def moves(self, values: NDArray[np.floating], rows: Array | None = None) -> Iterator[Array]:
        """What each direction does to `rows` (J, K) times the unknowns (K, pixels), their first held: (J, pixels).

        Only ratios to the first (m00, S0) are measured; `rows` are by default the unknowns themselves.
        """
        m = values.astype(np.float64)
        rows = np.eye(len(m)) if rows is None else rows
        shown = rows @ m
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = shown / shown[0]
        for direction in self.directions:
            moved = direction.turn @ m
            if direction.counts is not None:
                signal = (self.w @ m).astype(np.float32).reshape(-1, self.channels, m.shape[1])
                bent = signal.copy()
                direction.counts.apply(bent)
                moved += self.inverse @ (bent - signal).reshape(-1, m.shape[1])
            moved = rows @ moved
            yield moved - relative * moved[0]

    def errors(self, values: NDArray[np.floating], rows: Array | None = None) -> NDArray[np.float32]:
        """Standard errors (J, pixels) of what `moves` moves, in the unit of the values; that of the first is zero."""
        variance = sum(moved**2 for moved in self.moves(values, rows))
        return np.asarray(np.sqrt(variance), dtype=np.float32)
