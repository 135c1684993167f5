"""Which of the likeliest set's groups get a name, and how well what they explain predicts held-out tiles."""

from __future__ import annotations

import numpy as np

from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause, causes
from processing.diagnosis.search.fit import LEAST_GAIN, Fit, held_out, minimize
from processing.diagnosis.search.own_minima import OwnMinima, Visited
from processing.diagnosis.search.rules import ALONG_VALLEY, IMITATES, LIKELY
from processing.diagnosis.search.solution import Solution
from processing.diagnosis.search.space import Space
from processing.diagnosis.surface.problem import SurfaceProblem
from processing.diagnosis.surface.standard_errors import bent
from processing.reflectance.effects.base import ReflectanceEffect

#: [steps] Of a fit that looks for a deeper minimum in a bent valley.
STEPS = 8


def named_causes(search: OwnMinima, likeliest: Visited) -> tuple[Visited, tuple[Cause, ...]]:
    """The set of what can be named, the most certain first: the weakest is taken away while one may be imitated."""
    here = likeliest
    while here.groups:
        found = causes(search.posterior(here), search.left(here))
        weakest = found[-1]
        if not _doubted(search, here, weakest):
            return here, found
        search.say(f"{weakest.candidates[0].label} may be a part of something else")
        (group,) = (g for g in here.groups if search.candidates_of(g)[0] == weakest.candidates[0])
        here = search.at(here.groups - {group}, here)
    return here, ()


def _doubted(search: OwnMinima, here: Visited, cause: Cause) -> bool:
    if cause.probability < LIKELY or cause.log_odds < IMITATES:
        return True
    others = [c for c in here.space.candidates if c not in cause.candidates]
    rough = max((roughness(c) for c in others), default=0.0)
    if not rough or not search.left(here):
        return False
    # Beside an effect whose form is rough, what its form leaves over must not get a name of its own.
    start = search.at(frozenset()).fit.excess
    explained = start - here.fit.excess
    return 2 * cause.log_odds * here.state.unit < rough * explained


def roughness(candidate: Candidate) -> float:
    """Part of what an effect explains that its simple form may leave over."""
    effect = candidate.effect
    return effect.rough if isinstance(effect, ReflectanceEffect) else 0.0


def solution(problem: SurfaceProblem, search: OwnMinima, here: Visited) -> Solution:
    """What the named effects correct, and predictions of what was held out."""
    nothing = search.at(frozenset())
    fit = _deepest(problem, here.space, minimize(problem, here.space, here.fit.values))
    before = held_out(problem, nothing.space, nothing.fit)
    return Solution(nothing.space, nothing.fit, before, here.space, fit, held_out(problem, here.space, fit))


def _deepest(problem: SurfaceProblem, space: Space, fit: Fit) -> Fit:
    """A deeper minimum near by, if a valley is bent."""
    typical, best = space.joined("typical"), fit
    for k in np.flatnonzero(bent(space)):
        for sign in (ALONG_VALLEY, -ALONG_VALLEY):
            start = fit.values.copy()
            start[k] += sign * typical[k]
            tried = minimize(problem, space, start, steps=STEPS)
            best = tried if tried.excess < best.excess - LEAST_GAIN else best
    return best
