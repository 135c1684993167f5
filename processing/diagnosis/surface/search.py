"""The search over effects of the reflectance: that of the instrument, more careful with what imitates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import LEAST_GAIN, Fit, HeldOut, held_out, minimize
from processing.diagnosis.search.outcome import Found, Trial
from processing.diagnosis.search.search import DECISIVE_BESIDE, Search
from processing.diagnosis.search.space import Space
from processing.reflectance.effects.base import BentValley, ReflectanceEffect

#: Every effect of the pool is fitted, not only those that promise most: the model is far from linear in them.
LEADERS = 12
#: Part of what is left over that an effect must explain to be added. Several that each take a little together imitate
#: nearly any smooth pattern over an object.
LEAST_SHARE = 0.3
PROMISE = 0.2
#: Steps, in typical sizes, from which a minimum is looked for once more.
NEAR = 1.0
#: Standard deviations of the noise up to which a total excess is no structure: the noise is known to some percent only.
NO_STRUCTURE = 4.0


class SurfaceSearch(Search):
    """The search in one `SurfaceProblem`."""

    # Smooth patterns over an object imitate each other more than patterns over states do.
    decisive = DECISIVE_BESIDE

    _start: float | None = None

    def run(self) -> Found:
        """Search; then look for a deeper minimum near the one that was found."""
        found = super().run()
        typical, fit = found.space.joined("typical"), found.fit
        for k in np.flatnonzero(bent(found.space)):
            for sign in (NEAR, -NEAR):
                start = found.fit.values.copy()
                start[k] += sign * typical[k]
                tried = minimize(self.problem, found.space, start, steps=8)
                fit = tried if tried.excess < fit.excess - LEAST_GAIN else fit
        if fit is not found.fit:
            found.fit, found.after = fit, held_out(self.problem, found.space, fit)
        return found

    def _trials(
        self,
        space: Space,
        fit: Fit,
        out: HeldOut,
        pool: Sequence[Candidate],
        leaders: int = LEADERS,
        least: float = 0.0,
    ) -> list[Trial]:
        # What one step promises says little here, so nothing is left out for promising little.
        trials = super()._trials(space, fit, out, pool, max(leaders, LEADERS), PROMISE * least)
        if self._start is None:
            self._start = out.excess
        needed = LEAST_SHARE * (out.excess - 2 * self.noise_of(out))
        # Beside an effect whose form is rough, what its form leaves over must not get a name of its own; what both
        # together explain without a rest has one.
        rough = max((roughness(c) for c in space.candidates), default=0.0) * max(self._start - out.excess, 0.0)
        return [
            t
            for t in trials
            if out.excess - t.out.excess >= (needed if self._nothing_left(t.out) else max(needed, rough))
        ]

    def _nothing_left(self, out: HeldOut) -> bool:
        return out.excess < NO_STRUCTURE * self.noise_of(out)

    def _observability(self, found: Found) -> None:
        # With what was found: first surface alone does not even know the normal.
        offered = [c for c in self.pool if c not in found.space.candidates]
        found.information = {c: info for c, (_, info) in self.scores(found.space, found.fit, offered).items()}

    def structure(self, after: HeldOut, parameters: int) -> float:
        """Chi-square for each direction of structure that is left beyond what errors of the noise may cause."""
        excess = after.excess - NO_STRUCTURE * self.noise_of(after)
        weighty, _ = self.directions(excess)
        return float(max(excess, 0.0) / max(weighty - parameters, 1.0))


def bent(space: Space) -> NDArray[np.bool_]:
    """(K,) values of effects whose valley is bent."""
    return np.array([isinstance(c.effect, BentValley) for c in space.candidates for _ in c.parameters], dtype=bool)


def roughness(candidate: Candidate) -> float:
    """Part of what an effect explains that its simple form may leave over."""
    effect = candidate.effect
    return effect.rough if isinstance(effect, ReflectanceEffect) else 0.0
