"""The parts of an answer as they are stored: causes, correction, captures, and what cannot be seen."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from processing.arrays import Array
from processing.diagnosis.instrument.doubts import PARTS
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES, features
from processing.diagnosis.instrument.mueller_error import MuellerErrors
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.structure import Residual
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Answer, Cause, information, shown
from processing.diagnosis.search.decision import Judgement
from processing.diagnosis.search.fit import Fit, HeldOut, Solution
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.result import (
    BeyondNoise,
    CaptureReport,
    Combination,
    Correction,
    Error,
    FoundEffect,
    NoiseReport,
    NotMeasured,
    Ranked,
)
from processing.diagnosis.search.rules import (
    FAR_OFF,
    LIKELY,
    MOST_RANKED,
    NEEDED,
    SEEN,
    SMALL,
    SURE,
)
from processing.diagnosis.search.space import Space
from processing.diagnosis.search.stored import by_wavelength, parameters_of, scope_of
from processing.instrument.changes import places
from processing.instrument.model import AppliedEffect, EffectParameter

#: [correlation] From which on two values are told together.
TOGETHER = 0.9
#: [1] Ratio of the largest to the least error among the directions of values that are told together.
OPEN = 5.0


def closure(problem: InstrumentProblem, k: int, space: Space, values: Array) -> float | None:
    """Mean of I0 + I90 - I45 - I135 over mean S0, percent, of corrected counts over the gains of their channels."""
    model, data = problem.models[k], problem.captures[k]
    if model.mosaic is None or {c.name for c in model.channels} != {"0", "45", "90", "135"}:
        return None
    changes = problem.changes(k, space, values)
    coefficients = problem.coefficients(k, changes).reshape(len(FEATURES), *data.signal.shape[:2])
    good = data.usable & ~data.clipped
    if not good.any():
        return None
    means, place = np.zeros(len(model.channels)), [x[good] for x in places(*good.shape)]
    for channel, c in enumerate(model.channels):
        sign = 1.0 if c.name in ("0", "90") else -1.0
        for state in range(data.signal.shape[0]):
            counts = data.signal[state, channel][good].astype(np.float64)
            corrected = np.tensordot(coefficients[:-DERIVATIVES, state, channel], features(counts, *place)[0], axes=1)
            means[channel] += sign * corrected.mean() / changes.gain[state, channel]
    return float(100 * means.sum() / (np.abs(means).sum() / 2))


@dataclass(frozen=True)
class Tie:
    """Values `index` (n,) of which weights @ values is determined to `stderr`; `open_by` (n,) is one standard deviation
    of the direction that is determined least. The largest weight is one."""

    index: NDArray[np.int64]
    weights: Array
    value: float
    stderr: float
    open_by: Array


def ties(values: Array, covariance: Array, typical: Array) -> Iterator[Tie]:
    """Groups of values (K,) that are known together much better than each by itself, of their covariance (K, K)."""
    error = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    alike = np.abs(covariance / np.outer(error, error)) > TOGETHER
    count, group = connected_components(alike, directed=False)
    for k in range(count):
        index = np.flatnonzero(group == k)
        if index.size < 2:
            continue
        size, vector = np.linalg.eigh(covariance[np.ix_(index, index)] / np.outer(typical[index], typical[index]))
        if size[-1] < OPEN**2 * max(size[0], 0.0):
            continue
        weights = vector[:, 0] / typical[index]
        weights = weights / weights[np.argmax(np.abs(weights * error[index]))]
        variance = weights @ covariance[np.ix_(index, index)] @ weights
        yield Tie(
            index,
            weights,
            float(weights @ values[index]),
            float(np.sqrt(max(variance, 0.0))),
            vector[:, -1] * np.sqrt(size[-1]) * typical[index],
        )


def combinations(found: Posterior, solved: Solution) -> tuple[Combination, ...]:
    """Of the values of a correction, those that are only known together."""
    effects = set(solved.effects)
    at: list[int] = []
    names: list[str] = []
    units: list[str] = []
    for candidate, part in found.space.pairs:
        if candidate in effects and not candidate.effect.per_state:
            at += range(part.start, part.stop)
            single = candidate.size == 1
            names += [candidate.label if single else f"{candidate.label} {p.name}" for p in candidate.parameters]
            units += [p.unit for p in candidate.parameters]
    typical = found.space.joined("typical")[at]
    told = []
    for tie in ties(found.values[at], found.covariance[np.ix_(at, at)], typical):
        first = int(tie.index[np.argmin(np.abs(tie.weights - 1))])
        told.append(
            Combination(
                weights={names[i]: float(w) for i, w in zip(tie.index, tie.weights, strict=True)},
                value=tie.value,
                stderr=tie.stderr,
                unit=units[first],
                open_by={names[i]: float(v) for i, v in zip(tie.index, tie.open_by, strict=True)},
            )
        )
    return tuple(told)


def error(problem: InstrumentProblem, solved: Solution, out: HeldOut, k: int | None = None) -> Error:
    """A residual as it is told, of one capture `k` or of all, in the unit of the counts as they were taken."""
    held = "; ".join(dict.fromkeys(m.held_out for m in problem.moments))
    if problem.folds == 1:
        held = "nothing: too few values; each fitted value takes a degree of freedom"
    noise, rms, beyond = floor(problem, solved, k), 100 * out.rms, None
    if noise is not None:
        rms /= 1.0 if out is solved.before else stretch(problem, solved, k)
        beyond = BeyondNoise.of(out.excess, out.freedom, noise)
    return Error(rms_percent=rms, chi2_reduced=out.chi2_reduced, held_out=held, beyond_noise=beyond)


def floor(problem: InstrumentProblem, solved: Solution, k: int | None = None) -> float | None:
    """Rms noise over the mean signal, percent, of the counts as they were taken: of one capture or of all."""
    if not problem.noise_known:
        return None
    return 100 * _noise(problem, solved.base, solved.before_fit, k)


def stretch(problem: InstrumentProblem, solved: Solution, k: int | None = None) -> float:
    """By how much a bend of the response that is undone stretches noise, and residual, relative to the signal."""
    if not problem.noise_known:
        return 1.0
    taken = _noise(problem, solved.base, solved.before_fit, k)
    return _noise(problem, solved.space, solved.fit, k) / taken if taken > 0 else 1.0


def _noise(problem: InstrumentProblem, space: Space, fit: Fit, k: int | None) -> float:
    moments = problem.near(space, fit.values)[0].moments
    return float(np.sqrt(np.mean([m.noise_floor**2 for m in (moments if k is None else moments[k : k + 1])])))


def left_without(problem: InstrumentProblem, solved: Solution, effects: Collection[Candidate]) -> HeldOut:
    """What the correction would leave without some of its effects; for each degree of freedom, as after it."""
    values = solved.fit.values.copy()
    for candidate, part in solved.space.pairs:
        if candidate in effects:
            values[part] = 0.0
    sums = problem.sums(solved.space, values, derivatives=False)
    more = float(sums.excess.sum()) - solved.fit.excess
    return solved.after.and_more(more, float(sums.square.sum() - solved.fit.sums.square.sum()))


def told_effects(
    problem: InstrumentProblem, solved: Solution, cause: Cause, doubt: str | None, *, not_applied: str | None
) -> list[FoundEffect]:
    """A cause as it is told, given a reason to doubt it; one for each capture in which it shows."""
    without = left_without(problem, solved, (*cause.candidates, *cause.alternatives))
    if not any(c in solved.space.candidates for c in (*cause.candidates, *cause.alternatives)):
        not_applied = not_applied or doubt or "it is not needed in addition to the other causes"
    answer, probability = told_answer(cause, doubt)
    told = []
    # Of one with values of its own in every capture, those captures are told in which it shows.
    each = [
        at
        for found in zip(cause.candidates, cause.values, cause.covariance, strict=True)
        for at in by_wavelength(*found)
    ]
    sizes = [shown(values, covariance) for _, values, covariance in each]
    for (candidate, values, covariance), size in zip(each, sizes, strict=True):
        if size < min(1.0, max(sizes)):
            continue
        told.append(
            FoundEffect(
                kind=candidate.kind,
                element=candidate.place or None,
                parameters=parameters_of(candidate, values, np.sqrt(np.diag(covariance))),
                evidence=2 * cause.log_odds,
                indistinguishable_from=tuple(dict.fromkeys(c.short for c in cause.alternatives)),
                scope=scope_of(candidate),
                capture=None if candidate.capture is None else problem.captures[candidate.capture].name,
                wavelength_nm=candidate.wavelength_nm,
                removal_chance=1 - probability,
                confident=doubt is None and cause.answer not in ("unknown", "unlisted"),
                probability=probability,
                answer=answer,
                residual_without=error(problem, solved, without),
                residual_with=error(problem, solved, solved.after),
                not_applied=not_applied,
            )
        )
    return told


def told_answer(cause: Cause, doubt: str | None) -> tuple[Answer, float]:
    """The word for a cause and its probability: what may be a part of something else is not sure, what is doubted for
    another reason is not told."""
    if doubt is None:
        return cause.answer, cause.probability
    probability = min(cause.probability, LIKELY)
    if doubt not in PARTS or cause.probability < SURE:
        return "unknown", probability
    return "one of" if cause.alternatives else "unlisted" if cause.candidates[0].price else "likely", probability


def told_switches(problem: InstrumentProblem, solved: Solution) -> list[FoundEffect]:
    """Pixels that are left out because what they say is another thing than the others say."""
    told = []
    for candidate, part in solved.space.pairs:
        if candidate.effect.is_switch:
            value, never = solved.fit.values[part], np.zeros((1, 1))
            gain = left_without(problem, solved, (candidate,)).excess - solved.after.excess
            cause = Cause((candidate,), (value,), (never,), probability=1.0, log_odds=gain / 2, alternatives=())
            told += told_effects(problem, solved, cause, None, not_applied=None) if gain > 2 * NEEDED else []
    return told


def correction(
    problem: InstrumentProblem,
    found: Posterior,
    solved: Solution,
    any_cause: bool,
    *,
    judgement: Judgement,
    lasts: bool,
    used: Solution,
    errors: MuellerErrors,
) -> Correction:
    """What an instrument file would hold: means, with the spread over the sets; for these captures alone unless it
    `lasts`. Of it `used` is applied."""
    part = dict(found.space.pairs)
    chance = {found.space.candidates[m]: p for g, p in enumerate(found.samples.probability) for m in found.members[g]}
    effects = []
    for candidate, where in solved.space.pairs:
        if candidate in solved.base.candidates or not any_cause:
            continue
        covariance = found.covariance[part[candidate], part[candidate]]
        for one, values, own in by_wavelength(candidate, solved.fit.values[where], covariance):
            effects.append(
                AppliedEffect(
                    kind=one.kind,
                    element=one.place or None,
                    parameters=parameters_of(one, values, np.sqrt(np.maximum(np.diag(own), 0.0))),
                    probability=float(chance[candidate]),
                    captures=tuple(c.name for k, c in enumerate(problem.captures) if one.acts(k, c.wavelength_nm)),
                    scope=scope_of(one) if lasts else "capture",
                    wavelength_nm=_wavelength(problem, one),
                )
            )
    # Values that are merely nominal are nowhere near what is true.
    nominal = any(c.place for c in solved.base.candidates)
    known = judgement.refused is None or not nominal or (judgement.first is None and solved.before.rms < FAR_OFF)
    stored, told = (errors.uncertain(problem, used) if known else None) or (None, None)
    return Correction(
        effects=tuple(effects),
        systematic=stored,
        mueller=told,
        combinations=combinations(found, solved) if any_cause else (),
        checks=judgement.checks,
        refused=judgement.refused,
    )


def _wavelength(problem: InstrumentProblem, candidate: Candidate) -> float | None:
    """Wavelength at which the values hold; None for all of them."""
    several = sorted(set(problem.wavelengths_nm))
    effect = candidate.of_instrument
    if effect and problem.model.belongs_to.get(candidate.kind, effect.belongs_to) == "mechanics":
        return None
    if candidate.capture is not None:
        return problem.wavelengths_nm[candidate.capture]
    return several[0] if len(several) == 1 else candidate.wavelength_nm


def calibrated(problem: InstrumentProblem, found: Posterior, solved: Solution) -> dict[str, EffectParameter]:
    """Nominal values as fitted: one number, or one for each wavelength where they differ."""
    part = dict(found.space.pairs)
    values: dict[str, dict[float, tuple[float, float]]] = {}
    nominal = {c: p for c, p in solved.base.pairs if c.place}
    for candidate, where in nominal.items():
        covariance = found.covariance[part[candidate], part[candidate]]
        for one, (fitted,), ((variance,),) in by_wavelength(candidate, solved.fit.values[where], covariance):
            for model, wavelength in zip(problem.models, problem.wavelengths_nm, strict=True):
                if one.wavelength_nm in (None, wavelength):
                    start = float(model.value_of(candidate.place))  # type: ignore[arg-type]
                    value = start + float(fitted), float(np.sqrt(max(variance, 0.0)))
                    values.setdefault(candidate.place, {})[wavelength] = value
    unit = {c.place: c.parameters[0].unit for c in nominal}
    return {place: _by_wavelength(each, unit[place]) for place, each in values.items()}


def _by_wavelength(values: dict[float, tuple[float, float]], unit: str) -> EffectParameter:
    at = tuple(sorted(values))
    value, stderr = zip(*(values[w] for w in at), strict=True)
    if len(set(value)) == 1:
        return EffectParameter(value=value[0], stderr=stderr[0], unit=unit)
    return EffectParameter(value=value, stderr=stderr, unit=unit, wavelengths_nm=at)


def ranking(found: Posterior, before: HeldOut) -> tuple[Ranked, ...]:
    """Groups by what each would explain alone."""
    form, groups = found.sets.form, found.sets.groups
    total = max(before.excess + before.freedom, 1e-300)
    alone = []
    for k in np.flatnonzero(found.sets.free):
        g, h = form.gradient[groups[k].index], form.curvature[np.ix_(groups[k].index, groups[k].index)]
        alone.append((float(g @ np.linalg.solve(h + np.eye(g.size), g)), int(k)))
    return tuple(
        Ranked(
            candidate=found.label(k).label,
            evidence=round(gain, 1),
            rms_percent=100 * before.rms * float(np.sqrt(max(1 - gain / total, 0.0))),
        )
        for gain, k in sorted(alone, reverse=True)[:MOST_RANKED]
    )


def unobservable(problem: InstrumentProblem, found: Posterior) -> list[Candidate]:
    """Candidates about which the captures say nothing, the nominal values being free."""
    told, always = information(found)
    out = []
    for candidate, part in found.space.pairs:
        if candidate.state_chosen or candidate.effect.is_switch or np.isin(part.start, always):
            continue
        least = np.full(candidate.size, SEEN)
        if candidate.reaches_around:
            # Noise alone has slopes too, from one pixel to the next, which a shift would change.
            one = Space((candidate,))
            noise = np.diag(problem.noise_information(one, np.zeros(one.size))) * candidate.typical**2
            least = np.maximum(least, SMALL * noise)
        if np.all(told[part] < least):
            out.append(candidate)
    return out


def missing(unseen: list[Candidate]) -> list[Candidate]:
    """Of what is unobservable, what another sample could show."""
    return [c for c in unseen if not (c.acts_on_counts or c.effect.varies_over_image)]


def capture_report(
    problem: InstrumentProblem, k: int, solved: Solution, before: Residual, *, after: Residual
) -> CaptureReport:
    data = problem.captures[k]
    sample = "unknown" if data.sample is None else "known up to a throughput for each pixel"
    return CaptureReport(
        name=data.name,
        sample=sample,
        simulated=data.simulated,
        noise=data.noise_source,
        evidence=data.evidence,
        binned=data.binned,
        clipped_fraction=float(np.mean(data.clipped)),
        dark_fraction=data.dark_fraction,
        steep_fraction=0.0 if data.steep is None else float(data.steep.mean()),
        cut_off=data.cut_off,
        source_percent=_source_percent(problem, k, solved),
        wavelength_nm=data.wavelength_nm,
        error_before=error(problem, solved.undone, solved.before.of(k), k),
        error_after=error(problem, solved, solved.after.of(k), k),
        tests_before=before.tests,
        tests_after=after.tests,
        closure_before_percent=closure(problem, k, solved.base, solved.before_fit.values),
        closure_after_percent=closure(problem, k, solved.space, solved.fit.values),
    )


def _source_percent(problem: InstrumentProblem, k: int, solved: Solution) -> float | None:
    """Standard deviation of the level of the source over the states, where channels tell it."""
    if not problem.has_free_level(k):
        return None
    found = dict(solved.space.pairs)
    own = [p for c, p in found.items() if c.effect.is_projected and c.capture == k]
    level = 1 + solved.fit.values[own[0]] if own else None
    if level is None:
        data, mine = problem.captures[k], solved.space.acting(k, problem.wavelengths_nm[k])
        seen = problem.predicted(k, problem.changes(k, mine.space, mine.of(solved.fit.values)))
        measured = data.signal[:, :, data.usable].mean(axis=2, dtype=float)
        level = np.sum(measured * seen, axis=1) / np.sum(seen**2, axis=1)
    return 100 * float(np.std(level) / np.mean(level))


def not_measured(problem: InstrumentProblem) -> tuple[NotMeasured, ...]:
    """Frames, hits and pixels that were left out, as the frames are stored."""
    told = []
    for data in problem.captures:
        out = data.left_out
        if out:
            told.append(
                NotMeasured(
                    capture=data.name,
                    states=tuple(out.frames),
                    misfits_percent=tuple(100 * m for m in out.frames.values()),
                    exchanged=out.exchanged,
                    hits=tuple((n, c, y * out.pitch, x * out.pitch) for n, c, y, x in out.hits.tolist()),
                    pixels=tuple((y * out.pitch, x * out.pitch) for y, x in out.pixels.tolist()),
                    pitch=out.pitch,
                )
            )
    return tuple(told)


def noise_report(problem: InstrumentProblem) -> NoiseReport:
    """Whether the noise is what is declared."""
    several = len(problem.captures) > 1
    told = tuple(f"{c.name}: {line}" if several else line for c in problem.captures for line in c.told_of_noise)
    if told:
        return NoiseReport(verdict="not_as_declared", told=told)
    if not problem.noise_known:
        return NoiseReport(verdict="unknown")
    return NoiseReport(verdict="estimated" if any(c.noise_estimated for c in problem.captures) else "as_declared")
