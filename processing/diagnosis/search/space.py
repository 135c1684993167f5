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
    shares : (captures, 2, F) what each capture has of `square` and `count`.
    stretch : (F, K) half of the derivatives of `freedom`: a bend of the response stretches noise and structure alike.
    """

    excess: Array
    freedom: Array
    square: Array
    count: Array
    gradient: Array
    curvature: Array
    stretch: Array
    shares: Array

    @classmethod
    def empty(cls, folds: int, parameters: int, captures: int = 0) -> Sums:
        """All zero."""
        f, k = folds, parameters
        a, b, c, d = np.zeros((4, f))
        gradient, stretch = np.zeros((2, f, k))
        return cls(a, b, c, d, gradient, np.zeros((f, k, k)), stretch, np.zeros((captures, 2, f)))

    def add(self, capture: int, part: Sums, index: NDArray[np.int64], weight: float = 1.0) -> None:
        """Add the sums of one capture, by whose parameters at `index` it is derived; its chi-square counts `weight`."""
        self.excess += weight * part.excess
        self.freedom += weight * part.freedom
        self.square += part.square
        self.count += part.count
        self.shares[capture] += part.square, part.count
        if part.gradient.shape[1]:
            self.gradient[:, index] += weight * part.gradient
            self.stretch[:, index] += weight * part.stretch
            self.curvature[:, index[:, None], index] += weight * part.curvature


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

    def acting(self, capture: int, wavelength_nm: float) -> tuple[Space, NDArray[np.int64]]:
        """What acts on a capture, and where its values stand in the common vector."""
        chosen = [k for k, c in enumerate(self.candidates) if c.acts(capture, wavelength_nm)]
        index = [np.zeros(0, dtype=np.int64), *(np.r_[self.slices[k]] for k in chosen)]
        return Space(tuple(self.candidates[k] for k in chosen)), np.concatenate(index).astype(np.int64)

    def joined(self, name: str) -> Array:
        """A property of all candidates, end to end."""
        return np.concatenate([np.zeros(0), *(getattr(c, name) for c in self.candidates)])
