"""What no effect of the list is (`nameless_effects`), asked in a cause's place."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.nameless_effects import (
    PERIODS,
    ImageLag,
    JumpOfTheSource,
    TurningSample,
    WaveOfAPlate,
)
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause
from processing.diagnosis.search.linearized import quadratic
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import SURE
from processing.diagnosis.search.sets import Group, Sets, State
from processing.diagnosis.search.space import Space
from processing.instrument.effects.base import InstrumentEffect

#: [chi-square, fixed] That has odds of 99 to 1.
STANDS_OUT = 2 * float(np.log(SURE / (1 - SURE)))


class Nameless:
    """All of these beside the sets of a posterior, linearized about its values."""

    def __init__(self, problem: InstrumentProblem, found: Posterior) -> None:
        self._labels = [found.label(g) for g in range(len(found.members))]
        asked: dict[type[InstrumentEffect], list[Candidate]] = {
            WaveOfAPlate: _waves(problem),
            TurningSample: _turning(problem),
            ImageLag: _once(ImageLag(), problem),
            JumpOfTheSource: _jumps(problem),
        }
        space = Space((*found.space.candidates, *(c for each in asked.values() for c in each)))
        values = np.append(found.values, np.zeros(space.size - found.space.size))
        form = quadratic(problem, space, values, problem.sums(space, values))
        own = [Group(np.r_[part].astype(np.int64)) for part in space.slices[len(found.space.candidates) :]]
        # A state chosen among many explains something by chance alone.
        self._choice: dict[type[InstrumentEffect], float] = {
            JumpOfTheSource: 2 * float(np.log(max(len(asked[JumpOfTheSource]), 1)))
        }
        self._sets = Sets(form, (*found.sets.groups, *own), found.sets.noise)
        ends = np.cumsum([len(self._labels), *map(len, asked.values())]).tolist()
        self._groups = {effect: range(*pair) for effect, pair in zip(asked, pairwise(ends), strict=True)}
        best = found.samples.best
        self._state = State(np.append(best.tau, np.zeros(len(own))), best.unit)

    @classmethod
    def beside(cls, problem: InstrumentProblem, found: Posterior) -> Nameless | None:
        """None where these could not be told from others."""
        few = problem.holds_out_states or not problem.noise_known
        return None if few else cls(problem, found)

    def gains_over(self, cause: Cause) -> dict[type[InstrumentEffect], float]:
        """Chi-square that the best of each kind explains in a cause's place, beyond it and what it cannot be told from.

        Every value of either costs two, and a choice among many its logarithm; many values that are as small as they
        are cost less, as the odds of the cause say. Of those that stand out by themselves.
        """
        own = self._labels.index(cause.candidates[0])
        given = self._sets.given_others(self._sets.without(self._state, own))
        most = {
            kind: max((_explained(*given[g]) for g in of), default=0.0) - self._choice.get(kind, 0.0)
            for kind, of in self._groups.items()
        }
        named = [own, *(self._labels.index(other) for other in cause.alternatives)]
        there = max(2 * cause.log_odds, *(_explained(*given[g]) for g in named))
        return {kind: one - there for kind, one in most.items() if one > STANDS_OUT}


def _once(effect: InstrumentEffect, problem: InstrumentProblem) -> list[Candidate]:
    return [Candidate(effect, "", effect.parameters(problem.model, problem.captures[0].conditions, ""))]


def _turning(problem: InstrumentProblem) -> list[Candidate]:
    """One for each sample of unknown Mueller matrix: what is known is known as it stands."""
    unknown = [k for k, c in enumerate(problem.captures) if c.sample is None]
    return [replace(one, capture=k) for k in unknown for one in _once(TurningSample(), problem)]


def _jumps(problem: InstrumentProblem) -> list[Candidate]:
    effect = JumpOfTheSource()
    return [
        Candidate(effect, place, effect.parameters(problem.model, c.conditions, place), k)
        for k, c in enumerate(problem.captures)
        for place in effect.places(problem.model, c.conditions)
    ]


def _waves(problem: InstrumentProblem) -> list[Candidate]:
    conditions = problem.captures[0].conditions
    return [
        Candidate(effect, place, effect.parameters(problem.model, conditions, place))
        for what, periods in PERIODS.items()
        for effect in (WaveOfAPlate(what, h) for h in periods)
        for place in effect.places(problem.model, conditions)
    ]


def _explained(curvature: Array, gradient: Array) -> float:
    """Chi-square that values explain, less two for each (Akaike's criterion)."""
    return float(gradient @ np.linalg.pinv(curvature, hermitian=True) @ gradient) - 2 * gradient.size
