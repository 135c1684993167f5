"""The common vector of all active candidates, and the sums over the data that a fit needs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.instrument.effects.base import Switch


@dataclass
class Sums:
    """Sums over the data of each fold F.

    Attributes
    ----------
    excess : (F,) sum of squares in units of the noise, minus what noise is expected to give (`freedom`, (F,)).
    square : (F,) sum of squares relative to the mean signal; count : (F,) the degrees of freedom behind it.
    gradient, curvature : (F, K), (F, K, K), half of the derivatives of the excess.
    stretch : (F, K) half of the derivatives of `freedom`: a bend of the response stretches noise and structure alike.
    """

    excess: Array
    freedom: Array
    square: Array
    count: Array
    gradient: Array
    curvature: Array
    stretch: Array

    @classmethod
    def empty(cls, folds: int, parameters: int) -> Sums:
        """All zero."""
        f, k = folds, parameters
        zero = np.zeros(f)
        return cls(zero, zero.copy(), zero.copy(), zero.copy(), np.zeros((f, k)), np.zeros((f, k, k)), np.zeros((f, k)))


@dataclass
class Space:
    """Active candidates and where their values stand in the common vector."""

    candidates: tuple[Candidate, ...]
    slices: tuple[slice, ...] = field(init=False)
    size: int = field(init=False)

    def __post_init__(self) -> None:
        start, slices = 0, []
        for candidate in self.candidates:
            slices.append(slice(start, start + candidate.size))
            start += candidate.size
        self.slices, self.size = tuple(slices), start

    @property
    def fixed(self) -> NDArray[np.bool_]:
        """(K,) values that are on or off and not fitted."""
        return np.array([isinstance(c.effect, Switch) for c in self.candidates for _ in c.parameters], dtype=bool)

    def joined(self, name: str) -> Array:
        """A property of all candidates, end to end."""
        return np.concatenate([np.zeros(0), *(getattr(c, name) for c in self.candidates)])
