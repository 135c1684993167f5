"""From the posterior to an answer: a correction that holds, and names apart from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.cautious import cautious
from processing.diagnosis.instrument.doubts import AS_WELL, BESIDE_PATTERN, ELSE, acts_on_unknown, doubts, testable
from processing.diagnosis.instrument.empirical import empirical
from processing.diagnosis.instrument.evidence import wanted_for_evidence, would_be_seen
from processing.diagnosis.instrument.guard import chances, checks, lasts, predicted_changes, refusal
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.recommend import recommended
from processing.diagnosis.instrument.structure import Residual, beyond_chance, descriptions, residual
from processing.diagnosis.instrument.telling import (
    calibrated,
    capture_report,
    correction,
    error,
    floor,
    missing,
    noise_report,
    not_measured,
    ranking,
    told_effects,
    told_switches,
    unobservable,
)
from processing.diagnosis.instrument.whole_bench import WholeBench, predicts, solution
from processing.diagnosis.instrument.wiring import miswired, miswired_train
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause, causes
from processing.diagnosis.search.posterior import Posterior, Say
from processing.diagnosis.search.result import Diagnosis, Unexplained, Verdict
from processing.diagnosis.search.rules import GROWTH, LIKELY, WHITE
from processing.diagnosis.search.solution import Solution
from processing.instrument.effects.base import FieldEffect, ValuePerState
from processing.instrument.model import InstrumentModel


@dataclass(frozen=True)
class Judged:
    """The diagnosis, the correction before and after, and the residuals of both for the report."""

    diagnosis: Diagnosis
    found: Solution
    before: tuple[Residual, ...]
    after: tuple[Residual, ...]


def diagnose(problem: InstrumentProblem, say: Say, declared: InstrumentModel | None = None) -> Judged:
    """Find the posterior, test what is left, guard the correction, and name causes.

    `declared` is the instrument at all the wavelengths of its file.
    """
    wiring = miswired(problem, declared)
    if wiring is not None:
        say(wiring.told)
        problem = wiring.problem
    bench = WholeBench(problem, say)
    if bench.train_is_off:
        say("no values of the train fit: looking for a mistake of wiring")
        wiring = miswired_train(problem, declared)
        if wiring is not None:
            say(wiring.told)
            problem = wiring.problem
            bench = WholeBench(problem, say)
    found = bench.run()
    solved = solution(bench, found)
    say("testing what is left over")
    asked = predicts(problem)
    captures = range(len(problem.captures))
    before = tuple(residual(asked, k, solved.base, solved.before_fit) for k in captures)
    after = tuple(residual(asked, k, solved.space, solved.fit) for k in captures)
    units = np.array([1 + _left(problem, r) / directions(asked, k) for k, r in enumerate(after)])
    if problem.noise_known and _grown(units, found.samples.best.unit):
        # Single tests see structure that the sum of squares does not.
        found = bench.weighed(found, units)
        solved = solution(bench, found)
        after = tuple(residual(asked, k, solved.space, solved.fit) for k in captures)
    else:
        units = np.ones(len(after))
    structure = _structure(problem, after)
    left = float(sum(_left(problem, r) / u for r, u in zip(after, units, strict=True)))
    named = _told(found, left)
    untold = [
        c for c in named if isinstance(c.candidates[0].effect, ValuePerState) and not testable(asked, solved, c, named)
    ]
    named = tuple(c for c in named if c not in untold)
    # What as many values as the data have took away may be any structure.
    left += sum(2 * c.log_odds * found.samples.best.unit for c in untold)
    doubt = doubts(asked, found, solved, named, left)
    unfit = _unfit(problem, solved, named, untold, doubt)
    if unfit:
        solved = solution(bench, found, unfit)
        after = tuple(residual(asked, k, solved.space, solved.fit) for k in captures)
    here, later = predicted_changes(asked, found, solved)
    careful = cautious(asked, found, solved)
    if careful is not None:
        solved = solution(bench, replace(found, values=careful), unfit)
        after = tuple(residual(asked, k, solved.space, solved.fit) for k in captures)
        here, later = predicted_changes(asked, found, solved)
    sure = [c for c in named if c.answer != "unknown" and c not in doubt]
    if not sure:
        over = sum(_left(problem, r) for r in after)
        here, later = (c.beside(over, solved.before.excess - solved.after.excess) for c in (here, later))
    lasting = lasts(later, doubt.values())
    # Where there is nothing to apply, nothing is said of what it would do.
    guard, chance = checks(asked, solved), chances(here, later, lasting) if solved.effects else ()
    refused = f"change this first: {wiring.told}" if wiring is not None else refusal((*guard, *chance))
    switched = told_switches(asked, solved)
    verdict = _verdict((*named, *switched), (*sure, *switched), structure or bool(untold))
    if wiring is not None or (refusal(guard) is not None and named):
        verdict = "unexplained"
    if verdict == "consistent" and not would_be_seen(found):
        verdict = "undetermined"
    rivals = [(c.candidates[0], *c.alternatives) for c in named if c.alternatives]
    unexplained = None
    if verdict in ("unexplained", "partly_explained"):
        lines = descriptions([c.name for c in asked.captures], after)
        tried = tuple(c.candidates[0].label for c in named) or tuple(
            r.candidate for r in ranking(found, solved.before)[:5]
        )
        unexplained = Unexplained(description=lines, tried=tried, empirical=empirical(found, solved))
    unseen = unobservable(bench.whole, found)
    any_cause = bool(named or untold or switched)
    corrects = refused is None and (any_cause or bool(solved.base.size))
    kept = solved if corrects else _nothing(solved)
    correction_told = correction(problem, found, solved, any_cause, (*guard, *chance), refused, lasting, kept)
    diagnosis = Diagnosis(
        verdict=verdict,
        error_before=error(asked, solved.before),
        error_after=error(asked, kept.after),
        noise_floor_percent=floor(asked.near(kept.space, kept.fit.values)[0]),
        effects=(*(e for c in named for e in told_effects(problem, c, doubt.get(c))), *switched),
        unobservable=(
            *dict.fromkeys(c.short for c in unseen),
            *(f"{c.candidates[0].short} (as many values as the data have)" for c in untold),
        ),
        recommendation=wanted_for_evidence(problem)
        if verdict == "undetermined"
        else recommended(problem, kept.space, kept.fit, rivals, missing(unseen)),
        unexplained=unexplained,
        calibrated=calibrated(problem, found, solved),
        ranking=ranking(found, solved.before),
        captures=tuple(capture_report(asked, k, kept, before[k], after[k]) for k in captures),
        instrument=problem.model.name,
        wavelengths_nm=tuple(sorted(set(problem.wavelengths_nm))),
        simulated=any(c.simulated for c in problem.captures),
        correction=correction_told,
        wiring=None if wiring is None else wiring.told,
        left_out=not_measured(problem),
        noise=noise_report(problem),
    )
    return Judged(diagnosis, kept, before, after if corrects else before)


def _grown(units: Array, unit: float) -> bool:
    return bool(units.max() > GROWTH * unit)


def _unfit(
    problem: InstrumentProblem,
    solved: Solution,
    named: Sequence[Cause],
    untold: Sequence[Cause],
    doubt: Mapping[Cause, str],
) -> list[Candidate]:
    """What is not used where an unknown sample takes up a part of it, for it may be any structure or a part of such."""
    # Values that are not random, or as many as the data have; and those of a source that were found beside them.
    unfit = [*untold, *(cause for cause, reason in doubt.items() if reason in (*ELSE, *AS_WELL, BESIDE_PATTERN))]
    found = [c for cause in unfit for c in (*cause.candidates, *cause.alternatives)]
    if untold or any(reason in ELSE for reason in doubt.values()):
        # Something is there that is not in the list: only what has a name of its own is no part of it.
        own = {c for cause in named if cause not in doubt for c in (*cause.candidates, *cause.alternatives)}
        found += [
            c for c in solved.effects if c not in own and not (isinstance(c.effect, FieldEffect) or c.state_chosen)
        ]
    return [c for c in dict.fromkeys(found) if acts_on_unknown(problem, c)]


def directions(problem: InstrumentProblem, k: int) -> float:
    """Independent directions over which structure spreads in one capture."""
    free, power = problem.powers()[k]
    return max(free * float(power.sum() ** 2 / np.sum(power**2)), 1.0)


def _told(found: Posterior, left: float) -> tuple[Cause, ...]:
    return tuple(c for c in causes(found, left) if c.probability >= LIKELY)


def _nothing(solved: Solution) -> Solution:
    return Solution(solved.base, solved.before_fit, solved.before, solved.base, solved.before_fit, solved.before)


def _structure(problem: InstrumentProblem, after: Sequence[Residual]) -> bool:
    if problem.noise_known:
        return any(beyond_chance(r.tests) for r in after)
    return any(not _white(r) for r in after)


def _left(problem: InstrumentProblem, r: Residual) -> float:
    """Chi-square of the structure of one capture; none where no test sees any: of many some err by two deviations."""
    return r.left if _structure(problem, [r]) else 0.0


def _verdict(named: Sequence[object], sure: Sequence[object], structure: bool) -> Verdict:
    if not structure:
        if not named:
            return "consistent"
        return "explained" if sure else "partly_explained"
    return "partly_explained" if sure else "unexplained"


def _white(r: Residual) -> bool:
    mean = r.mean[np.isfinite(r.mean)]
    if mean.size < 8 or not np.any(mean):
        return True
    centred = mean - mean.mean()
    lag = float(centred[1:] @ centred[:-1] / (centred @ centred))
    return bool(abs(lag) * np.sqrt(mean.size) < WHITE)
