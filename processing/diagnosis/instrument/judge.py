"""From what the search found to a verdict: named only if the evidence allows no other reading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.moments import DERIVATIVES, FEATURES, features
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.recommend import recommended
from processing.diagnosis.instrument.structure import LIMIT, Residual, description, residual
from processing.diagnosis.instrument.unevenness import unevenness
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import covariance, minimize
from processing.diagnosis.search.outcome import Found
from processing.diagnosis.search.result import (
    CaptureReport,
    Diagnosis,
    Empirical,
    Error,
    FoundEffect,
    Ranked,
    Unexplained,
    Verdict,
)
from processing.diagnosis.search.search import CHANCE, Say, Search
from processing.diagnosis.search.space import Space
from processing.instrument.effects.base import (
    CountsEffect,
    FieldEffect,
    GeneralEffect,
    ImageShift,
    SourceEffect,
    Switch,
    ValuePerState,
)
from processing.instrument.model import EffectParameter

#: Share of the excess that must be explained before anything is named while structure is left.
SHARE = 0.97
#: Standard deviations of the worst test up to which what is left unexplained is not yet much.
MILD = 7.0
#: An effect keeps its name beside much that is unexplained if it explains so many times that, in chi-square: no
#: effect's model is exact to more than 5 % of its size. The same beside weak effects that come with it.
TIMES = 400.0
#: Where the noise is not known from the detector, what is left may be noise: an effect is named then if it explains
#: this share of the excess by itself.
ALONE = 0.9
#: More effects at once than these are less likely than one cause that is not in the list.
MOST_AT_ONCE = 2
#: Share of the scatter of values that belong to one state each which a single wave may hold, if they are to be random.
ONE_WAVE = 0.85
#: Standard deviations, and share of what it explains, by which the size of an effect of the source may differ over the
#: image.
UNEVEN, UNEVEN_SHARE = 6.0, 0.01
#: An information about a parameter below this, in chi-square for its typical size, is none.
SEEN = 4.0
#: Relative error of the noise: information that is less than this share of it may be noise.
NOISE_ERROR = 0.05
#: Autocorrelation over the states, in standard deviations, from which on a residual of few pixels is not white.
WHITE = 4.0


@dataclass(frozen=True)
class Judged:
    """The diagnosis, and the residuals before and after for the report."""

    diagnosis: Diagnosis
    found: Found
    before: tuple[Residual, ...]
    after: tuple[Residual, ...]


def diagnose(problem: InstrumentProblem, say: Say) -> Judged:
    """Search, test what is left, and judge."""
    search = Search(problem, say)
    found = search.run()
    if problem.holds_out_states and any(isinstance(c.effect, ValuePerState) for c in found.effects):
        # Parts of the states that are held out have each a throughput of their own, so values for each state could
        # differ by a factor from part to part.
        found.fit = minimize(problem.undivided(), found.space, found.fit.values)
    say("testing what is left over")
    captures = range(len(problem.captures))
    before = tuple(residual(problem, k, found.base, found.before_fit) for k in captures)
    after = tuple(residual(problem, k, found.space, found.fit) for k in captures)
    _unname(problem, search, found, after)
    verdict = _verdict(problem, search, found, after)
    if verdict == "unexplained" and found.effects:
        tried = found.effects
        found.space, found.fit, found.after = found.base, found.before_fit, found.before
        after = before
    else:
        tried = tuple(t.candidate for t in found.ranking[:5]) if verdict == "unexplained" else ()
    stderr = _standard_errors(problem, search, found)
    unseen = _unobservable(problem, found)
    rivals = [(e, *found.sets[e]) for e in found.effects if found.sets.get(e)]
    unexplained = None
    if verdict in ("unexplained", "partly_explained"):
        empirical = _empirical(problem, search, found)
        lines = tuple(line for r in after for line in description(r))
        unexplained = Unexplained(description=lines, tried=tuple(c.label for c in tried), empirical=empirical)
    diagnosis = Diagnosis(
        verdict=verdict,
        error_before=_error(problem, found.before),
        error_after=_error(problem, found.after),
        noise_floor_percent=_floor(problem.near(found.space, found.fit.values)[0]),
        effects=tuple(_effect(problem, found, c, stderr) for c in found.effects),
        unobservable=unseen,
        recommendation=recommended(problem, found.space, found.fit, rivals, _missing(problem, found)),
        unexplained=unexplained,
        calibrated=_calibrated(problem, found, stderr),
        ranking=tuple(
            Ranked(candidate=t.candidate.label, evidence=round(t.evidence, 1), rms_percent=100 * t.out.rms)
            for t in found.ranking[:10]
        ),
        captures=tuple(_capture(problem, k, found, before[k], after[k]) for k in captures),
        instrument=problem.model.name,
        wavelength_nm=problem.captures[0].wavelength_nm,
        simulated=any(c.simulated for c in problem.captures),
    )
    return Judged(diagnosis, found, before, after)


def _unname(problem: InstrumentProblem, search: Search, found: Found, after: Sequence[Residual]) -> None:
    """Take back what was added but cannot be called by a name: less than what is left, or values that are one wave."""
    structure = any(value > LIMIT for r in after for value in r.tests.values())
    structure |= not problem.noise_known and bool(found.effects)
    left = max(found.after.excess - problem.noise_known * 2 * search.noise_of(found.after), 0.0)
    worst = max((r.worst[1] for r in after if r.tests), default=np.inf)
    sharp = problem.noise_known and not any(c.noise_estimated for c in problem.captures)
    alone = [] if sharp else [c for c in found.effects if found.alone.get(c, 0.0) >= ALONE]
    small = []
    if structure and worst > MILD:
        # With much structure left, several effects together may imitate one that is not in the list.
        remains = TIMES * sum(r.left if r.tests else np.inf for r in after)
        small = [c for c in found.effects if c not in alone and found.gain.get(c, 0.0) < remains]
    elif structure:
        small = [c for c in found.effects if found.gain.get(c, np.inf) < left]
    weak = sorted(found.effects, key=lambda c: -found.gain.get(c, 0.0))[MOST_AT_ONCE:]
    rest = TIMES * sum(found.gain.get(c, 0.0) for c in weak)
    small += [c for c in found.effects if weak and c not in alone and found.gain.get(c, 0.0) < rest]
    # An effect has to beat chance to be named; values for each state leave too few directions to ask that.
    if not any(isinstance(c.effect, ValuePerState) for c in found.effects):
        small += [c for c in found.effects if found.chance.get(c, 1.0) > CHANCE]
    uneven = [c for c in found.effects if isinstance(c.effect, SourceEffect) and _uneven(problem, found, c)]
    # What is uneven is another cause, and smaller effects beside it may be parts of it.
    limit = max((found.gain.get(c, 0.0) for c in uneven), default=0.0)
    small += uneven + [c for c in found.effects if c not in uneven and found.gain.get(c, np.inf) < limit]
    part = dict(zip(found.space.candidates, found.space.slices, strict=True))
    curvature = found.fit.sums.curvature.sum(axis=0)
    waves = [
        c
        for c in found.effects
        if isinstance(c.effect, ValuePerState)
        and _one_wave(found.fit.values[part[c]], curvature[part[c], part[c]]) > ONE_WAVE
    ]
    found.nameless += dict.fromkeys((*small, *waves))


def _uneven(problem: InstrumentProblem, found: Found, candidate: Candidate) -> bool:
    """A source that changes does so by the same share in the whole image; what differs from part to part is none."""
    if any(isinstance(c.effect, FieldEffect) for c in found.effects):
        return False
    excess, terms = unevenness(problem, candidate, found.space, found.fit.values)
    return bool(excess > max(UNEVEN * np.sqrt(2 * terms), UNEVEN_SHARE * found.gain.get(candidate, 0.0)))


def _one_wave(values: Array, information: Array) -> float:
    """Largest share of what values (N,) explain that one sine over the states would explain as well.

    `information` (N, N) is the curvature of the chi-square: patterns that the unknown sample takes up do not count.
    """
    n = values.size
    k = np.arange(n)
    power, vector = np.linalg.eigh(information)
    root = (vector * np.sqrt(np.maximum(power, 0.0))).T
    seen = root @ values
    total = float(seen @ seen)
    # N values fitted to noise alone explain N.
    if total <= 2 * n:
        return 0.0
    best = 0.0
    for rate in np.linspace(0.5 / n, 0.5, 8 * n):
        wave = np.stack([np.cos(2 * np.pi * rate * k), np.sin(2 * np.pi * rate * k)], axis=1)
        u, size, _ = np.linalg.svd(root @ wave, full_matrices=False)
        along = u[:, size > 1e-6 * size[0]].T @ seen
        best = max(best, float(along @ along))
    return best / (total - n)


def _verdict(problem: InstrumentProblem, search: Search, found: Found, after: Sequence[Residual]) -> Verdict:
    structure = any(value > LIMIT for r in after for value in r.tests.values())
    if not problem.noise_known:
        structure = any(not _white(r) for r in after)
        if not found.effects and not structure:
            return "consistent"
    if not found.effects:
        return "unexplained" if structure else "consistent"
    if any(isinstance(c.effect, ValuePerState) for c in found.nameless):
        # A pattern over the states that is regular is not what this name means, and no other name fits.
        return "unexplained"
    if not structure:
        # Nothing is left, but what took it away may stand for something else.
        return "explained" if any(c not in found.nameless for c in found.effects) else "partly_explained"
    unexplained = max(found.after.excess - problem.noise_known * 2 * search.noise_of(found.after), 0.0)
    if problem.noise_known and all(c in found.nameless for c in found.effects):
        return "unexplained"
    explained = 1 - unexplained / max(found.before.excess, 1e-300)
    sure = all(found.chance.get(c, 1.0) < CHANCE for c in found.effects)
    return "partly_explained" if explained >= SHARE and sure else "unexplained"


def _white(r: Residual) -> bool:
    mean = r.mean[np.isfinite(r.mean)]
    if mean.size < 8 or not np.any(mean):
        return True
    centred = mean - mean.mean()
    lag = float(centred[1:] @ centred[:-1] / (centred @ centred))
    return bool(abs(lag) * np.sqrt(mean.size) < WHITE)


def _error(problem: InstrumentProblem, out: object) -> Error:
    held = "; ".join(dict.fromkeys(m.held_out for m in problem.moments))
    return Error(
        rms_percent=100 * getattr(out, "rms", 0.0), chi2_reduced=getattr(out, "chi2_reduced", 0.0), held_out=held
    )


def _floor(problem: InstrumentProblem) -> float | None:
    """Rms noise over the mean signal, percent; of the corrected counts, since a bend stretches both."""
    if not problem.noise_known:
        return None
    return 100 * float(np.sqrt(np.mean([m.noise_floor**2 for m in problem.moments])))


def _spread(search: Search, found: Found) -> float:
    unit = 1.0 if search.problem.noise_known else 0.0
    return unit + search.structure(found.after, found.space.size)


def _standard_errors(problem: InstrumentProblem, search: Search, found: Found) -> Array:
    noise_only = problem.noise_information(found.space, found.fit.values)
    scatter = covariance(found.space, found.fit, noise_only)[0] * _spread(search, found)
    return np.asarray(np.sqrt(np.maximum(np.diag(scatter), 0)))


def _parameters(candidate: Candidate, values: Array, stderr: Array) -> dict[str, EffectParameter]:
    if isinstance(candidate.effect, Switch):
        return {"left_out": EffectParameter(value=1.0, unit="1", note="pixels with a clipped state are left out")}
    if isinstance(candidate.effect, ValuePerState):
        unit = candidate.parameters[0].unit
        return {"states": EffectParameter(value=tuple(values.tolist()), stderr=tuple(stderr.tolist()), unit=unit)}
    return {
        p.name: EffectParameter(value=float(v), stderr=float(s), unit=p.unit)
        for p, v, s in zip(candidate.parameters, values, stderr, strict=True)
    }


def _effect(problem: InstrumentProblem, found: Found, candidate: Candidate, stderr: Array) -> FoundEffect:
    part = found.space.slices[found.space.candidates.index(candidate)]
    return FoundEffect(
        kind=candidate.kind,
        element=candidate.place or None,
        parameters=_parameters(candidate, found.fit.values[part], stderr[part]),
        evidence=found.evidence.get(candidate, 0.0),
        indistinguishable_from=tuple(dict.fromkeys(c.short for c in found.sets.get(candidate, ()))),
        scope="instrument" if candidate.capture is None else "capture",
        capture=None if candidate.capture is None else problem.captures[candidate.capture].name,
        removal_chance=found.chance.get(candidate, 1.0),
        confident=candidate not in found.nameless,
    )


def _calibrated(problem: InstrumentProblem, found: Found, stderr: Array) -> dict[str, EffectParameter]:
    if not found.base.candidates:
        return {}
    out = {}
    for candidate in found.base.candidates:
        index = found.space.slices[found.space.candidates.index(candidate)].start
        element, _, field = candidate.place.rpartition(".")
        start = float(next(getattr(e, field) for e in problem.model.elements() if e.name == element))
        value = start + float(found.fit.values[index])
        out[candidate.place] = EffectParameter(
            value=value, stderr=float(stderr[index]), unit=candidate.parameters[0].unit
        )
    return out


def _unobservable(problem: InstrumentProblem, found: Found) -> tuple[str, ...]:
    names = []
    for candidate, information in found.information.items():
        gain, least = np.diag(information) * candidate.typical**2, np.full(candidate.size, SEEN)
        if isinstance(candidate.effect, ImageShift):
            # Noise alone has slopes too, from one pixel to the next, which a shift would change.
            one = Space((candidate,))
            noise = np.diag(problem.noise_information(one, np.zeros(one.size))) * candidate.typical**2
            gain, least = gain - noise, np.maximum(least, NOISE_ERROR * noise)
        if not candidate.state_chosen and np.all(gain < least):
            names.append(candidate.short)
    names += [f"{c.short} (as many values as the data have)" for c in found.untestable]
    return tuple(dict.fromkeys(names))


def _missing(problem: InstrumentProblem, found: Found) -> list[Candidate]:
    # Only what another sample could show is worth a recommendation.
    return [
        c
        for c, information in found.information.items()
        if not c.state_chosen
        and not isinstance(c.effect, CountsEffect)
        and np.all(np.diag(information) * c.typical**2 < SEEN)
        and not isinstance(c.effect, FieldEffect)
    ]


def _empirical(problem: InstrumentProblem, search: Search, found: Found) -> Empirical | None:
    """The best of: a gain for each state, an angle for each state, a bend of the response."""
    best: tuple[float, str, str, Array, float] | None = None
    fits = []
    for candidate in search.pool:
        if not isinstance(candidate.effect, GeneralEffect) or candidate in found.space.candidates:
            continue
        space = Space((*found.space.candidates, candidate))
        fit = minimize(problem, space, np.concatenate([found.fit.values, np.zeros(candidate.size)]))
        rms = float(np.sqrt(fit.sums.square.sum() / fit.sums.count.sum()))
        fits.append((candidate, fit.excess))
        if best is None or fit.excess < best[0]:
            unit = candidate.parameters[0].unit
            best = (fit.excess, candidate.effect.describes, unit, fit.values[space.slices[-1]], rms)
    if best is None or best[0] > 0.9 * found.fit.excess:
        return None
    excess, describes, unit, values, rms = best
    near = excess + 0.02 * (found.fit.excess - excess) + 3 * search.noise_of(found.after)
    return Empirical(
        kind=describes,
        rms_percent_in_sample=100 * rms,
        values=tuple(values.tolist()),
        unit=unit,
        would_also_fit=tuple(dict.fromkeys(c.short for c, e in fits if e <= near)),
    )


def _capture(problem: InstrumentProblem, k: int, found: Found, before: Residual, after: Residual) -> CaptureReport:
    data = problem.captures[k]
    sample = "unknown" if data.sample is None else "known up to a throughput for each pixel"
    return CaptureReport(
        name=data.name,
        sample=sample,
        simulated=data.simulated,
        noise=data.noise_source,
        binned=data.binned,
        clipped_fraction=float(np.mean(data.clipped)),
        dark_fraction=data.dark_fraction,
        cut_off=data.cut_off,
        tests_before=before.tests,
        tests_after=after.tests,
        closure_before_percent=closure(problem, k, found.base, found.before_fit.values),
        closure_after_percent=closure(problem, k, found.space, found.fit.values),
    )


def closure(problem: InstrumentProblem, k: int, space: Space, values: Array) -> float | None:
    """Mean of I0 + I90 - I45 - I135 over mean S0, percent, of corrected counts over the gains of their channels."""
    model, data = problem.model, problem.captures[k]
    if model.mosaic is None or {c.name for c in model.channels} != {"0", "45", "90", "135"}:
        return None
    changes = problem.changes(k, space, values)
    coefficients = problem.coefficients(k, changes).reshape(len(FEATURES), *data.signal.shape[:2])
    good = data.usable & ~data.clipped
    if not good.any():
        return None
    means = np.zeros(len(model.channels))
    for channel, c in enumerate(model.channels):
        sign = 1.0 if c.name in ("0", "90") else -1.0
        for state in range(data.signal.shape[0]):
            counts = data.signal[state, channel][good].astype(np.float64)
            corrected = np.tensordot(coefficients[:-DERIVATIVES, state, channel], features(counts)[0], axes=1)
            means[channel] += sign * corrected.mean() / changes.gain[state, channel]
    return float(100 * means.sum() / (np.abs(means).sum() / 2))
