"""From the posterior to an answer: a correction that holds, and names apart from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from processing.diagnosis.instrument.empirical import empirical
from processing.diagnosis.instrument.guard import chances, checks, lasts
from processing.diagnosis.instrument.names import Names, names_of
from processing.diagnosis.instrument.outcome import Outcome, outcome_of
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.recommend import recommended
from processing.diagnosis.instrument.structure import Residual, descriptions
from processing.diagnosis.instrument.systematic import MuellerErrors
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
from processing.diagnosis.instrument.whole_bench import WholeBench
from processing.diagnosis.instrument.wiring import Wiring, miswired, miswired_train
from processing.diagnosis.search.evidence import wanted_for_evidence, would_be_seen
from processing.diagnosis.search.guard import refusal
from processing.diagnosis.search.judge import Judgement
from processing.diagnosis.search.posterior import Say
from processing.diagnosis.search.result import Diagnosis, FoundEffect, Unexplained
from processing.diagnosis.search.rules import MOST_TRIED
from processing.diagnosis.search.solution import Solution
from processing.instrument.model import InstrumentModel


@dataclass(frozen=True)
class Judged:
    """The diagnosis, the correction before and after, and the residuals of both for the report.

    `explained` is the residual with all causes that were found, also where the correction is refused.
    `problem` is what they are the answer to: on the branch nearest to the instrument file, without a mistake of wiring.
    """

    diagnosis: Diagnosis
    problem: InstrumentProblem
    found: Solution
    before: tuple[Residual, ...]
    after: tuple[Residual, ...]
    explained: tuple[Residual, ...]


def diagnose(problem: InstrumentProblem, say: Say, declared: InstrumentModel | None = None) -> Judged:
    """Find the posterior, test what is left, guard the correction, and name causes.

    `declared` is the instrument at all the wavelengths of its file.
    """
    wiring, bench = _wired(problem, say, declared)
    found = bench.run()
    say("testing what is left over")
    used = outcome_of(bench, found)
    return _told(used, names_of(used), told_switches(used.asked, used.solved), wiring)


def _wired(problem: InstrumentProblem, say: Say, declared: InstrumentModel | None) -> tuple[Wiring | None, WholeBench]:
    """The bench without a mistake of wiring, and which one that was."""
    wiring = miswired(problem, declared)
    if wiring is not None:
        say(wiring.told)
        problem = wiring.problem
    bench = WholeBench(problem, say)
    if not bench.train_is_off:
        return wiring, bench
    say("no values of the train fit: looking for a mistake of wiring")
    wiring = miswired_train(problem, declared)
    if wiring is None:
        return None, bench
    say(wiring.told)
    return wiring, WholeBench(wiring.problem, say)


def _told(used: Outcome, names: Names, switched: Sequence[FoundEffect], wiring: Wiring | None) -> Judged:
    problem, asked, found, solved = used.bench.problem, used.asked, used.found, used.solved
    errors = MuellerErrors.of(asked, found, solved)
    here, later, of_each = errors.changes(solved)
    each = dict(zip((c.name for c in problem.captures), of_each, strict=True)) if len(of_each) > 1 else {}
    lasting = lasts(later, names.doubt.values())
    judgement = Judgement(
        named=bool(names.named or switched),
        sure=bool(names.sure or switched),
        structure=used.structure or bool(names.untold),
        seen=bool(would_be_seen(found)),
        figures=checks(asked, solved),
        # Where there is nothing to apply, nothing is said of what it would do.
        chances=chances(here, later, lasting, each) if solved.effects else (),
        first=None if wiring is None else wiring.told,
    )
    any_cause = judgement.named or bool(names.untold)
    # What makes the residual worse is no cause, however well it fits.
    worse = refusal(judgement.figures)
    kept, verdict = judgement.kept(solved, any_cause), judgement.verdict
    unseen = unobservable(used.bench.whole, found)
    diagnosis = Diagnosis(
        verdict=verdict,
        error_before=error(asked, solved, solved.before),
        error_after=error(asked, kept, kept.after),
        noise_floor_percent=floor(asked, kept),
        effects=(
            *(
                e
                for c in names.named
                for e in told_effects(asked, solved, c, worse or names.doubt.get(c), judgement.refused)
            ),
            *switched,
        ),
        unobservable=(
            *dict.fromkeys(c.short for c in unseen),
            *(f"{c.candidates[0].short} (as many values as the data have)" for c in names.untold),
        ),
        recommendation=wanted_for_evidence(problem)
        if verdict == "undetermined"
        else recommended(problem, kept.space, kept.fit, names.rivals, missing(unseen)),
        unexplained=_unexplained(used, names) if verdict in ("unexplained", "partly_explained") else None,
        calibrated=calibrated(problem, found, kept),
        ranking=ranking(found, solved.before),
        captures=tuple(
            capture_report(asked, k, kept, *of_one)
            for k, of_one in enumerate(zip(used.before, used.after, strict=True))
        ),
        instrument=problem.model.name,
        wavelengths_nm=tuple(sorted(set(problem.wavelengths_nm))),
        simulated=any(c.simulated for c in problem.captures),
        correction=correction(problem, found, solved, any_cause, judgement, lasting, kept, errors),
        wiring=judgement.first,
        branch=used.bench.branch,
        left_out=not_measured(problem),
        noise=noise_report(problem),
    )
    return Judged(diagnosis, problem, kept, used.before, used.after if kept is solved else used.before, used.after)


def _unexplained(used: Outcome, names: Names) -> Unexplained:
    tried = tuple(c.candidates[0].label for c in names.named)
    return Unexplained(
        description=descriptions([c.name for c in used.asked.captures], used.after),
        tried=tried or tuple(r.candidate for r in ranking(used.found, used.solved.before)[:MOST_TRIED]),
        empirical=empirical(used.found, used.solved),
    )
