"""What a posterior comes to: its correction, tested for structure in what it leaves."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.structure import Residual, residual
from processing.diagnosis.instrument.whole_bench import WholeBench, predicts, solution
from processing.diagnosis.search.judge import beyond_chance
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import GROWTH, WHITE
from processing.diagnosis.search.solution import Solution


@dataclass(frozen=True)
class Outcome:
    """A posterior, its correction, and what is left of each capture before and after it.

    Attributes
    ----------
    structure : whether any test sees structure in what the mean of the posterior leaves; left : chi-square of it, in
        units of each capture's own.
    """

    bench: WholeBench
    asked: InstrumentProblem
    found: Posterior
    solved: Solution
    before: tuple[Residual, ...]
    after: tuple[Residual, ...]
    structure: bool
    left: float


def outcome_of(bench: WholeBench, found: Posterior) -> Outcome:
    """Test what is left; where single tests see structure that the sum of squares does not, weigh all anew."""
    asked, solved = predicts(bench.problem), solution(bench, found)
    captures = range(len(asked.captures))
    before = tuple(residual(asked, k, solved.base, solved.before_fit) for k in captures)
    after = residuals(asked, solved)
    units = np.array([1 + left_of(asked, r) / directions(asked, k) for k, r in enumerate(after)])
    if asked.noise_known and grown(units, found.samples.best.unit):
        found = bench.weighed(found, units)
        solved = solution(bench, found)
        after = residuals(asked, solved)
    else:
        units = np.ones(len(after))
    left = float(sum(left_of(asked, r) / u for r, u in zip(after, units, strict=True)))
    return Outcome(bench, asked, found, solved, before, after, has_structure(asked, after), left)


def residuals(problem: InstrumentProblem, solved: Solution) -> tuple[Residual, ...]:
    """What a correction leaves of every capture."""
    return tuple(residual(problem, k, solved.space, solved.fit) for k in range(len(problem.captures)))


def grown(units: Array, unit: float) -> bool:
    """Whether a capture leaves more, in units of chi-square, than the posterior reckoned with."""
    return bool(units.max() > GROWTH * unit)


def directions(problem: InstrumentProblem, k: int) -> float:
    """Independent directions over which structure spreads in one capture."""
    free, power = problem.powers()[k]
    return max(free * float(power.sum() ** 2 / np.sum(power**2)), 1.0)


def has_structure(problem: InstrumentProblem, after: Collection[Residual]) -> bool:
    """Whether a residual has structure; where its noise is unknown, of states beside each other."""
    if problem.noise_known:
        return any(beyond_chance(r.tests) for r in after)
    return any(not white(r) for r in after)


def left_of(problem: InstrumentProblem, r: Residual) -> float:
    """Chi-square of the structure of one capture; none where no test sees any: of many some err by two deviations."""
    return r.left if has_structure(problem, [r]) else 0.0


def white(r: Residual) -> bool:
    """Whether the mean residual of a state tells nothing of that of the next one."""
    mean = r.mean[np.isfinite(r.mean)]
    if mean.size <= WHITE**2 or not np.any(mean):
        return True
    centred = mean - mean.mean()
    lag = float(centred[1:] @ centred[:-1] / (centred @ centred))
    return bool(abs(lag) * np.sqrt(mean.size) < WHITE)
