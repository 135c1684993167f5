"""What the search tries, and what it has found."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import Fit, HeldOut
from processing.diagnosis.search.space import Space
from processing.instrument.effects.base import PointwiseEffect, Switch

#: Growth of the unweighted residual that is still put down to noise.
WORSE = 1.002


@dataclass
class Trial:
    """A candidate fitted together with the active effects."""

    candidate: Candidate
    space: Space
    fit: Fit
    out: HeldOut
    evidence: float = 0.0
    rank: float = 0.0

    @property
    def at_bound(self) -> bool:
        """A value stands at a bound: the data ask for something else."""
        lower, upper = self.space.joined("lower"), self.space.joined("upper")
        near = np.minimum(self.fit.values - lower, upper - self.fit.values) < 1e-3 * (upper - lower)
        for candidate, part in zip(self.space.candidates, self.space.slices, strict=True):
            near[part] &= not isinstance(candidate.effect, Switch)
        return bool(near.any())

    def sound(self, before: HeldOut) -> bool:
        """No value runs to its bound, and the residual itself does not grow.

        What fits better only where the weights are large is not an explanation. A bend of the response changes the
        scale in which the residual is told, so it is not asked.
        """
        bends = isinstance(self.candidate.effect, PointwiseEffect)
        return not self.at_bound and (bends or self.out.rms <= WORSE * before.rms)


@dataclass
class Found:
    """Result of the search: the final space and fit, and for each effect what else could be it."""

    base: Space
    before: HeldOut
    before_fit: Fit
    space: Space
    fit: Fit
    after: HeldOut
    evidence: dict[Candidate, float] = field(default_factory=dict)
    chance: dict[Candidate, float] = field(default_factory=dict)
    gain: dict[Candidate, float] = field(default_factory=dict)
    sets: dict[Candidate, tuple[Candidate, ...]] = field(default_factory=dict)
    ranking: list[Trial] = field(default_factory=list)
    alone: dict[Candidate, float] = field(default_factory=dict)  # share of the excess that each explains by itself
    information: dict[Candidate, Array] = field(default_factory=dict)  # with no effect active
    untestable: tuple[Candidate, ...] = ()
    nameless: list[Candidate] = field(default_factory=list)
    imitable: bool = False  # values for each state were added on the way, which can hide plain effects

    @property
    def effects(self) -> tuple[Candidate, ...]:
        """Effects found, without the nominal values of the train."""
        return self.space.candidates[len(self.base.candidates) :]
