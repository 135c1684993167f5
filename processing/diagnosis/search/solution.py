"""The correction that was found, before and after, on data that the fit did not see."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import Fit, HeldOut
from processing.diagnosis.search.space import Space


@dataclass
class Solution:
    """Before and after, on data that the fit did not see.

    Attributes
    ----------
    base : what is always fitted; space : that, and the effects of the correction (the mean of the posterior).
    before_fit, fit : at these; before, after : predictions of what was held out.
    weak : (K,) curvature of the prior of the values of `space`.
    """

    base: Space
    before_fit: Fit
    before: HeldOut
    space: Space
    fit: Fit
    after: HeldOut
    weak: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def effects(self) -> tuple[Candidate, ...]:
        """Effects of the correction."""
        return self.space.candidates[len(self.base.candidates) :]

    @property
    def undone(self) -> Solution:
        """Nothing corrected."""
        return Solution(self.base, self.before_fit, self.before, self.base, self.before_fit, self.before)
