"""Diagnose captures against an instrument model: posterior, tests of its residual, names, correction and verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from processing.computing.blas import one_blas_thread
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.captures.read_capture import read_capture
from processing.diagnosis.captures.screening import screen_capture
from processing.diagnosis.instrument.answer import calibrated, capture_report, noise_report, not_measured
from processing.diagnosis.instrument.doubts import doubts, find_changed, testable
from processing.diagnosis.instrument.mueller_error import MuellerErrors, chances, lasts
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.recommend import recommended
from processing.diagnosis.instrument.structure import Residual, compute_residual, descriptions
from processing.diagnosis.instrument.whole_bench import WholeBench, validation_problem
from processing.diagnosis.instrument.wiring import Arrangement, find_train_miswiring, likeliest_arrangement
from processing.diagnosis.search.causes import OPEN_WIRING, Names, causes, observable_effects
from processing.diagnosis.search.correction import solution
from processing.diagnosis.search.decision import Judgement, beyond_chance
from processing.diagnosis.search.fit import Solution
from processing.diagnosis.search.posterior import Posterior, Say
from processing.diagnosis.search.result import Diagnosis
from processing.diagnosis.search.rules import FAR_OFF, LIKELY, LIMIT, SURE
from processing.diagnosis.verdict.answer import Answer, checks, effects_of_switches, unobservable
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture, CaptureError


def has_structure(problem: InstrumentProblem, r: Residual) -> bool:
    """Whether a residual has structure; where its noise is unknown, of states beside each other."""
    return bool(beyond_chance(r.tests)) if problem.noise_known else not white(r, len(problem.model.channels))


def white(r: Residual, channels: int) -> bool:
    """Whether the mean residual of a state tells nothing of that of the next one.

    Channels of one state go together: where its level is projected out, two of them are opposite.
    """
    mean = np.nan_to_num(r.mean).reshape(-1, channels)
    if len(mean) <= LIMIT**2 or not np.any(mean):
        return True
    centred = mean - mean.mean(axis=0)
    lag = float(np.sum(centred[1:] * centred[:-1]) / np.sum(centred**2))
    return bool(abs(lag) * np.sqrt(len(mean)) < LIMIT)


def names_of(
    problem: InstrumentProblem, posterior: Posterior, solved: Solution, excess: float, *, is_open: bool = False
) -> Names:
    """Names of the causes of a posterior, as far as the chi-square of structure that is left over allows them.

    `is_open` : another wiring, or other values of the train, fit nearly as well.
    """
    likely = tuple(c for c in causes(posterior, excess) if c.probability >= LIKELY)
    untold = tuple(c for c in likely if c.candidates[0].effect.per_state and not testable(problem, solved, c, likely))
    named = tuple(c for c in likely if c not in untold)
    # What as many values as the data have took away may be any structure.
    excess += sum(2 * c.log_odds * posterior.samples.best.unit for c in untold)
    doubt = dict.fromkeys(named if is_open else (), OPEN_WIRING)
    return Names(named, doubt | doubts(problem, posterior, solved, named, chi2=excess), untold)


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
    arrangement, bench = _rewire(problem, say, declared)
    problem, posterior = bench.problem, bench.run()
    say("testing what is left over")
    validation, unfit = validation_problem(problem), bench.as_many_as_intensities(posterior, 1 - SURE)
    solved = solution(validation, posterior, bench.base, bench.base.vector(bench.start), unfit=unfit)
    captures = range(len(validation.captures))
    before, after = (tuple(compute_residual(validation, k, *end) for k in captures) for end in solved.ends)
    # Where no test sees any, there is none: of many captures some err by two deviations.
    excess = sum(r.excess for r in after if has_structure(validation, r))
    # Other values of the train count only if this one is far: its image, say, may explain the capture.
    is_open = arrangement.is_open and (arrangement.message is not None or bench.is_far(posterior))
    names = names_of(validation, posterior, solved, excess, is_open=is_open)
    switched = effects_of_switches(validation, solved)
    errors = MuellerErrors.of(validation, posterior, solved)
    now, later, of_each = errors.changes(solved)
    each = dict(zip((c.name for c in problem.captures), of_each, strict=True)) if len(of_each) > 1 else {}
    lasting = lasts(later, solved, find_changed(validation, solved, names.doubt))
    judgement = Judgement(
        named=bool(names.named or switched or posterior.any_cause),
        sure=bool(names.sure or switched),
        # What no name explains is as open as structure that is left.
        structure=any(has_structure(validation, r) for r in after)
        or bool(names.untold)
        or (posterior.any_cause and not names.named),
        observable=bool(observable_effects(posterior)),
        figures=checks(validation, solved),
        # Where there is nothing to apply, nothing is said of what it would do.
        chances=chances(now, later, lasting, each) if solved.effects else (),
        first=arrangement.message,
    )
    answer = Answer(validation, posterior, solved, names, judgement, switched)
    final, unseen = answer.applied, unobservable(bench.whole, posterior)
    # With another wiring M is wrong by far more; values that are merely nominal are nowhere near what is true.
    nominal = any(c.place for c in solved.base.candidates)
    is_near = judgement.refused is None or not nominal or solved.before.rms < FAR_OFF
    is_known = judgement.first is None and is_near
    diagnosis = Diagnosis(
        **answer.fields(
            recommended=lambda: recommended(problem, final.space, final.fit, names.rivals, unseen=unseen),
            descriptions=descriptions([c.name for c in validation.captures], after),
            captures=[
                capture_report(validation, k, final, r, after=left)
                for k, (r, left) in enumerate(zip(before, after, strict=True))
            ],
            unseen=unseen,
            calibrated=calibrated(problem, posterior, final),
            lasts=lasting,
            uncertain=errors.uncertain(problem, final, lasting=lasting) if is_known else None,
        ),
        wiring=judgement.first,
        branch=bench.branch or (arrangement.branch if is_open else None),
        left_out=not_measured(problem),
        noise=noise_report(problem),
    )
    return Judged(diagnosis, problem, final, before, after if final is solved else before, after)


def _rewire(problem: InstrumentProblem, say: Say, declared: InstrumentModel | None) -> tuple[Arrangement, WholeBench]:
    """How the train is put together, and the bench without a mistake of it."""
    arrangement = likeliest_arrangement(problem, declared)
    if arrangement.message is not None:
        say(arrangement.message)
    bench = WholeBench(arrangement.problem, say, arrangement.train)
    if not bench.train_is_off:
        return arrangement, bench
    say("no values of the train fit: looking for a mistake of wiring")
    wiring = find_train_miswiring(problem, declared)
    if wiring is None:
        return arrangement, bench
    message, rewired = wiring
    say(message)
    return replace(arrangement, message=message), WholeBench(rewired, say)


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
