"""Diagnose captures against an instrument model: posterior, tests of its residual, names, correction and verdict."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from processing.computing.blas import one_blas_thread
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.captures.read_capture import read_capture
from processing.diagnosis.captures.screening import screen_capture
from processing.diagnosis.instrument.answer import calibrated, capture_report, missing, noise_report, not_measured
from processing.diagnosis.instrument.doubts import doubts, find_changed, testable
from processing.diagnosis.instrument.mueller_error import MuellerErrors, chances, lasts
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.recommend import recommended
from processing.diagnosis.instrument.structure import Residual, compute_residual, descriptions
from processing.diagnosis.instrument.whole_bench import WholeBench, validation_problem
from processing.diagnosis.instrument.wiring import Wiring, find_miswiring, find_train_miswiring
from processing.diagnosis.search.causes import causes, observable_effects
from processing.diagnosis.search.correction import solution
from processing.diagnosis.search.decision import Judgement, beyond_chance
from processing.diagnosis.search.fit import Solution
from processing.diagnosis.search.names import Names
from processing.diagnosis.search.posterior import Posterior, Say
from processing.diagnosis.search.result import Diagnosis, FoundEffect
from processing.diagnosis.search.rules import FAR_OFF, LIKELY, OUTSTANDING, SHARES
from processing.diagnosis.verdict.answer import Answer, checks, effects_of_switches, unobservable
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture, CaptureError


@dataclass(frozen=True)
class Outcome:
    """A posterior, its correction, and what is left of each capture before and after it.

    Attributes
    ----------
    structure : whether any test sees structure in what the mean of the posterior leaves; excess : chi-square of it.
    """

    bench: WholeBench
    validation: InstrumentProblem
    posterior: Posterior
    solved: Solution
    before: tuple[Residual, ...]
    after: tuple[Residual, ...]
    structure: bool
    excess: float


def outcome_of(bench: WholeBench, posterior: Posterior) -> Outcome:
    """Test what a posterior leaves."""
    problem = validation_problem(bench.problem)
    unfit = bench.as_many_as_intensities(posterior, SHARES)
    solved = solution(problem, posterior, bench.base, bench.base.vector(bench.start), unfit=unfit)
    captures = range(len(problem.captures))
    before = tuple(compute_residual(problem, k, solved.base, solved.before_fit) for k in captures)
    after = tuple(compute_residual(problem, k, solved.space, solved.fit) for k in captures)
    excess = sum(structure_chi2(problem, r) for r in after)
    return Outcome(bench, problem, posterior, solved, before, after, has_structure(problem, after), excess)


def has_structure(problem: InstrumentProblem, after: Collection[Residual]) -> bool:
    """Whether a residual has structure; where its noise is unknown, of states beside each other."""
    if problem.noise_known:
        return any(beyond_chance(r.tests) for r in after)
    return any(not white(r) for r in after)


def structure_chi2(problem: InstrumentProblem, r: Residual) -> float:
    """Chi-square of the structure of one capture; none where no test sees any: of many some err by two deviations."""
    return r.excess if has_structure(problem, [r]) else 0.0


def white(r: Residual) -> bool:
    """Whether the mean residual of a state tells nothing of that of the next one."""
    mean = r.mean[np.isfinite(r.mean)]
    if mean.size <= OUTSTANDING**2 or not np.any(mean):
        return True
    centred = mean - mean.mean()
    lag = float(centred[1:] @ centred[:-1] / (centred @ centred))
    return bool(abs(lag) * np.sqrt(mean.size) < OUTSTANDING)


def names_of(outcome: Outcome) -> Names:
    """Names of the causes of a posterior, as far as what is left over allows them."""
    problem, posterior, solved = outcome.validation, outcome.posterior, outcome.solved
    likely = tuple(c for c in causes(posterior, outcome.excess) if c.probability >= LIKELY)
    untold = tuple(c for c in likely if c.candidates[0].effect.per_state and not testable(problem, solved, c, likely))
    named = tuple(c for c in likely if c not in untold)
    # What as many values as the data have took away may be any structure.
    excess = outcome.excess + sum(2 * c.log_odds * posterior.samples.best.unit for c in untold)
    return Names(named, doubts(problem, posterior, solved, named, chi2=excess), untold)


@dataclass(frozen=True)
class Judged:
    """The diagnosis, the correction before and after, and the residuals of both for the report.

    `explained` is the residual with all causes that were found, also where the correction is refused.
    `problem` is what they are the answer to: on the branch nearest to the instrument file, without a mistake of wiring.
    """

    diagnosis: Diagnosis
    problem: InstrumentProblem
    solution: Solution
    before: tuple[Residual, ...]
    after: tuple[Residual, ...]
    explained: tuple[Residual, ...]


def diagnose(problem: InstrumentProblem, say: Say, declared: InstrumentModel | None = None) -> Judged:
    """Find the posterior, test what is left, guard the correction, and name causes.

    `declared` is the instrument at all the wavelengths of its file.
    """
    wiring, bench = _rewire(problem, say, declared)
    posterior = bench.run()
    say("testing what is left over")
    used = outcome_of(bench, posterior)
    return _judge(used, names_of(used), effects_of_switches(used.validation, used.solved), wiring)


def _rewire(problem: InstrumentProblem, say: Say, declared: InstrumentModel | None) -> tuple[Wiring | None, WholeBench]:
    """The bench without a mistake of wiring, and which one that was."""
    wiring = find_miswiring(problem, declared)
    if wiring is not None:
        say(wiring.message)
        problem = wiring.problem
    bench = WholeBench(problem, say)
    if not bench.train_is_off:
        return wiring, bench
    say("no values of the train fit: looking for a mistake of wiring")
    wiring = find_train_miswiring(problem, declared)
    if wiring is None:
        return None, bench
    say(wiring.message)
    return wiring, WholeBench(wiring.problem, say)


def _judge(used: Outcome, names: Names, switched: Sequence[FoundEffect], wiring: Wiring | None) -> Judged:
    problem, validation, posterior, solved = used.bench.problem, used.validation, used.posterior, used.solved
    errors = MuellerErrors.of(validation, posterior, solved)
    now, later, of_each = errors.changes(solved)
    each = dict(zip((c.name for c in problem.captures), of_each, strict=True)) if len(of_each) > 1 else {}
    lasting = lasts(later, solved, find_changed(validation, solved, names.doubt))
    judgement = Judgement(
        named=bool(names.named or switched or posterior.any_cause),
        sure=bool(names.sure or switched),
        structure=used.structure or bool(names.untold),
        observable=bool(observable_effects(posterior)),
        figures=checks(validation, solved),
        # Where there is nothing to apply, nothing is said of what it would do.
        chances=chances(now, later, lasting, each) if solved.effects else (),
        first=None if wiring is None else wiring.message,
    )
    answer = Answer(validation, posterior, solved, names, judgement, switched)
    final, unseen = answer.applied, unobservable(used.bench.whole, posterior)
    # Values that are merely nominal are nowhere near what is true.
    nominal = any(c.place for c in solved.base.candidates)
    is_known = judgement.refused is None or not nominal or (judgement.first is None and solved.before.rms < FAR_OFF)
    diagnosis = Diagnosis(
        **answer.fields(
            recommended=lambda: recommended(problem, final.space, final.fit, names.rivals, unseen=missing(unseen)),
            descriptions=descriptions([c.name for c in validation.captures], used.after),
            captures=[
                capture_report(validation, k, final, before, after=after)
                for k, (before, after) in enumerate(zip(used.before, used.after, strict=True))
            ],
            unseen=unseen,
            calibrated=calibrated(problem, posterior, final),
            lasts=lasting,
            uncertain=errors.uncertain(problem, final) if is_known else None,
        ),
        wiring=judgement.first,
        branch=used.bench.branch,
        left_out=not_measured(problem),
        noise=noise_report(problem),
    )
    return Judged(diagnosis, problem, final, used.before, used.after if final is solved else used.before, used.after)


@one_blas_thread()
def diagnose_captures(
    captures: Sequence[Path | str], model: InstrumentModel, say: Say = lambda line: None
) -> tuple[Judged, InstrumentProblem]:
    """Diagnose capture files jointly.

    Parameters
    ----------
    captures
        Of one instrument, at one wavelength or several; what is known of each sample is in the file.
    model
        As loaded from its file.
    say
        Called with a line of text at each step.

    Returns
    -------
    Verdict, names and correction; and the problem that they are the answer to.

    Raises
    ------
    CaptureError
        A file cannot be used, or none is given.

    Examples
    --------
    >>> judged, _ = diagnose_captures(["air.h5"], InstrumentModel.load("instrument.yaml"))
    >>> [(effect.kind, effect.element) for effect in judged.diagnosis.effects]
    [('psg_azimuth', 'psg_retarder')]
    """
    if not captures:
        raise CaptureError("no capture to diagnose: one file or several of one instrument are wanted")
    models: list[InstrumentModel] = []
    data: list[CaptureData] = []
    for path in map(Path, captures):
        say(f"reading {path.name}")
        with Capture(path) as capture:
            models.append(model.nominal_at(capture.header.wavelength_nm))
            data.append(screen_capture(read_capture(capture, models[-1]), models[-1], say))
    judged = diagnose(InstrumentProblem(models, data), say, model)
    return judged, judged.problem
