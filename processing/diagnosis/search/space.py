"""The common vector of all active candidates, the sums over the data that a fit needs, and who makes them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.rules import FAR
from processing.instrument.model import InstrumentModel


@dataclass
class Sums:
    """Sums over the data of each fold F.

    Attributes
    ----------
    excess : (F,) sum of squares in units of the noise, minus what noise is expected to give (`freedom`, (F,)).
    square : (F,) sum of squares relative to the mean signal; count : (F,) the degrees of freedom behind it.
    gradient, curvature : (F, K), (F, K, K), half of the derivatives of the excess.
    shares : (captures, 4, F) what each capture has of `square`, `count`, `excess` and `freedom`.
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
        return cls(a, b, c, d, gradient, np.zeros((f, k, k)), stretch, np.zeros((captures, 4, f)))

    def chi2(self, noise_known: bool) -> float:
        """Chi-square beyond noise; all of it where the noise is not known."""
        return float(self.excess.sum()) + (0.0 if noise_known else float(self.freedom.sum()))

    def add(self, capture: int, part: Sums, acting: Acting) -> None:
        """Add the sums of one capture, derived by what is `acting` on it."""
        self.excess += part.excess
        self.freedom += part.freedom
        self.square += part.square
        self.count += part.count
        self.shares[capture] += part.square, part.count, part.excess, part.freedom
        if part.gradient.shape[1]:
            index = acting.index
            self.gradient[:, index] += acting.spread(part.gradient)
            self.stretch[:, index] += acting.spread(part.stretch)
            self.curvature[:, index[:, None], index] += acting.spread_products(part.curvature)


@dataclass(frozen=True)
class Acting:
    """Part of a common vector that acts on one capture.

    Attributes
    ----------
    space : candidates as they are at the capture's wavelength.
    index : (J,) positions in the common vector.
    own, weight : (J,) the value of `space` that each of them adds to, and its factor there.
    """

    space: Space
    index: NDArray[np.int64]
    own: NDArray[np.int64]
    weight: Array

    def of(self, values: Array) -> Array:
        """Values of `space`, of the common vector."""
        return np.asarray(np.bincount(self.own, self.weight * values[self.index], self.space.size), dtype=float)

    def spread(self, slopes: Array) -> Array:
        """Derivatives (..., J) by the common values, of those (..., own values)."""
        return slopes if self._is_plain else np.asarray(slopes[..., self.own] * self.weight)

    @cached_property
    def _is_plain(self) -> bool:
        """Whether each common value is one of `space`, as it is."""
        return np.array_equal(self.own, np.arange(self.space.size)) and bool(np.all(self.weight == 1))

    def spread_products(self, products: Array) -> Array:
        """The same of products (..., own values, own values)."""
        return products if self._is_plain else self.spread(products)[..., self.own, :] * self.weight[:, None]


@dataclass
class Space:
    """Active candidates and where their values stand in the common vector."""

    candidates: tuple[Candidate, ...]
    slices: tuple[slice, ...] = field(init=False)
    size: int = field(init=False)
    _owner: NDArray[np.int64] = field(init=False, repr=False, compare=False)
    _acting: dict[tuple[int, float], Acting] = field(init=False, repr=False, compare=False, default_factory=dict)

    def __post_init__(self) -> None:
        start, slices = 0, []
        for candidate in self.candidates:
            slices.append(slice(start, start + candidate.size))
            start += candidate.size
        self.slices, self.size = tuple(slices), start
        self._owner = np.repeat(np.arange(len(slices)), [c.size for c in self.candidates])

    @property
    def fixed(self) -> NDArray[np.bool_]:
        """(K,) values that are on or off and not fitted."""
        return np.array([c.effect.is_switch for c in self.candidates for _ in c.parameters], dtype=bool)

    def acting(self, capture: int, wavelength_nm: float) -> Acting:
        """Candidates that act on a capture, and the positions of their values in the common vector."""
        if (capture, wavelength_nm) not in self._acting:
            self._acting[capture, wavelength_nm] = self._of_capture(capture, wavelength_nm)
        return self._acting[capture, wavelength_nm]

    def _of_capture(self, capture: int, wavelength_nm: float) -> Acting:
        chosen = [k for k, c in enumerate(self.candidates) if c.acts(capture, wavelength_nm)]
        index = [np.zeros(0, dtype=np.int64), *(np.r_[self.slices[k]] for k in chosen)]
        subspace = Space(tuple(self.candidates[k].at(wavelength_nm) for k in chosen))
        # Of a curve each coefficient adds to one value.
        mix = block_diag(*(self.candidates[k].matrix(wavelength_nm) for k in chosen))
        return Acting(subspace, np.concatenate(index).astype(np.int64), np.abs(mix).argmax(axis=0), mix.sum(axis=0))

    @property
    def pairs(self) -> list[tuple[Candidate, slice]]:
        """Candidates, each with where its values stand in the common vector."""
        return list(zip(self.candidates, self.slices, strict=True))

    def owner(self, position: int) -> int:
        """Number of the candidate that a value of the common vector belongs to."""
        return int(self._owner[position])

    def other_than_zero(self, values: Array) -> Iterator[tuple[Candidate, Array]]:
        """Candidates of which a value is not zero, each with its values, of the common vector (K,)."""
        for k in np.unique(self._owner[np.flatnonzero(values)]):
            yield self.candidates[k], values[self.slices[k]]

    def split(self, values: Array) -> dict[Candidate, Array]:
        """Values by candidate, of the common vector (K,)."""
        return {c: values[p] for c, p in self.pairs}

    def vector(self, values: Mapping[Candidate, Array]) -> Array:
        """Common vector (K,) of values by candidate, zero where none are given."""
        return np.concatenate([np.zeros(0), *(values.get(c, np.zeros(c.size)) for c in self.candidates)])

    def positions(self, numbers: Iterable[int]) -> NDArray[np.int64]:
        """Positions (J,) of the values of some candidates, by their numbers, in the common vector."""
        return np.concatenate([np.zeros(0, dtype=np.int64), *(np.r_[self.slices[k]] for k in numbers)]).astype(np.int64)

    def is_far(self, values: Array) -> NDArray[np.bool_]:
        """Whether values (K,) are beyond the plausible."""
        return np.asarray(np.abs(values) > FAR * self.joined("typical"))

    def joined(self, name: str) -> Array:
        """A property of all candidates, end to end."""
        return np.concatenate([np.zeros(0), *(getattr(c, name) for c in self.candidates)])


class Problem(Protocol):
    """Interface of the search to measured data and a model.

    Attributes
    ----------
    captures : each with a name, a wavelength, and whether it is simulated; model : the instrument.
    folds : parts that are held out in turn; `holds_out_states` says that the parts are states, `held_out` it in words.
    noise_known : the excess is in units of a known noise.
    spread : see `Moments`.
    """

    model: InstrumentModel
    folds: int
    noise_known: bool
    holds_out_states: bool
    spread: float

    @property
    def captures(self) -> Sequence[Any]: ...
    @property
    def held_out(self) -> str: ...

    def noise_floor(self, space: Space, values: Array, k: int | None = None) -> float:
        """Rms noise over the mean signal, of one capture or of all, with the counts corrected by these values."""
        ...

    def sums(self, space: Space, values: Array, *, derivatives: bool = True) -> Sums:
        """Excess, and with `derivatives` its half gradient and curvature, of every fold."""
        ...

    def powers(self) -> list[tuple[int, Array]]:
        """Rows that the unknowns leave over, and the power of each component of the signal, for each capture."""
        ...

    def relinearize(self, space: Space, values: Array) -> bool:
        """Take these values as the point that corrections are expanded about; False if one as close is known."""
        ...

    def noise_information(self, space: Space, values: Array) -> tuple[Array, Array]:
        """Parts (K, K) of the curvature that the noise of image derivatives makes, and that of the data themselves."""
        ...

    def time_noise(self, space: Space, values: Array) -> Array:
        """Variance (K,) of values for each state that errors of the frames' times make; 0 of all others."""
        ...
