"""Diagnose captures of an object against a reflectance model: search, names, verdict, and what a correction does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from processing.arrays import Array
from processing.computing.blas import one_blas_thread
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause, causes, wanted_for_evidence, would_be_seen
from processing.diagnosis.search.decision import Judgement, beyond_chance
from processing.diagnosis.search.fit import LEAST_GAIN, Fit, HeldOut, Solution, held_out, minimize
from processing.diagnosis.search.own_minima import OwnMinima, Visited
from processing.diagnosis.search.posterior import Say
from processing.diagnosis.search.range_of import part_outside, rank_of
from processing.diagnosis.search.result import (
    BeyondNoise,
    CaptureReport,
    Correction,
    Diagnosis,
    Error,
    FoundEffect,
    Ranked,
    Unexplained,
)
from processing.diagnosis.search.rules import (
    APART,
    IMITATES,
    LIKELY,
    LIMIT,
    MOST_RANKED,
    MOST_TRIED,
    SEEN,
)
from processing.diagnosis.search.space import Space
from processing.diagnosis.search.stored import parameters_of
from processing.diagnosis.surface.data import SurfaceData, read_surface
from processing.diagnosis.surface.guard import chances, checks
from processing.diagnosis.surface.problem import SurfaceProblem, structure
from processing.diagnosis.surface.quantities import SurfaceQuantities, quantities
from processing.diagnosis.surface.standard_errors import bent, standard_errors
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import AppliedEffect, InstrumentModel
from processing.polarization.image_difference import rmsd
from processing.storage.captures.capture import Capture, CaptureError

#: [typical sizes] Along a bent valley, from where a deeper minimum is looked for.
ALONG_VALLEY = 1.0
#: [of the signal] Structure up to which a linear Stokes camera cannot tell an effect from small eigenvalues that are
#: not equal: apart by what the paper saw (9 % at 451 nm, 3 % at 662 nm) they leave 0.1 to 2 % on the simulated sphere.
AS_LIKELY = 0.015
#: [1] More effects than this at once are not an explanation.
MOST_EFFECTS = 3
#: [of each test's excess] What may be left where something is named all the same.
LEFT_OVER = 0.03

#: [steps] Of a fit that looks for a deeper minimum in a bent valley.
VALLEY_STEPS = 8


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
    rough = max((c.effect.rough for c in others), default=0.0)
    if not rough or not search.left(here):
        return False
    # Beside an effect whose form is rough, what its form leaves over must not get a name of its own.
    start = search.at(frozenset()).fit.excess
    explained = start - here.fit.excess
    return 2 * cause.log_odds * here.state.unit < rough * explained


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
            tried = minimize(problem, space, start, steps=VALLEY_STEPS)
            best = tried if tried.excess < best.excess - LEAST_GAIN else best
    return best


def recommended(
    problem: SurfaceProblem,
    space: Space,
    fit: Fit,
    rivals: Sequence[Candidate],
    *,
    verdict: str,
    before: Sequence[dict[str, float]],
) -> str:
    """One sentence."""
    own = "smooth over the object, of the instrument"
    if verdict == "unexplained":
        if any(tests.get(own, 0.0) > LIMIT for tests in before):
            return (
                "No Mueller matrix at all explains these intensities: diagnose the instrument first, without "
                "--reflectance and best on air, then come back with the instrument file that it writes."
            )
        return (
            "The dominant process, or the assumption that the other three are equal, does not hold in a way that is "
            "not in the list: take a full Mueller capture, look at its eigenvalues (`process xi0`) and at psi and |D|."
        )
    if not rivals:
        return "None needed."
    for candidate in rivals:
        if candidate.effect.advice:
            return candidate.effect.advice
    if len(rivals) > 1 and _apart(problem, space, fit, rivals) >= APART:
        return "Their signatures differ: repeat the capture with more light or more frames."
    if rank_of(problem.rows(0, problem.changes(0, space, fit.values)[0])) < 16:
        return "Take a full Mueller capture of the same object: one angle of polarization at each pixel is too little."
    return "Take captures at two more arm angles, at least 30 degrees apart, and diagnose them together."


def _apart(problem: SurfaceProblem, space: Space, fit: Fit, rivals: Sequence[Candidate]) -> float:
    """Smallest sine between the signatures of two rivals in these captures."""
    signatures = []
    for candidate in rivals:
        alone = Space((candidate,))
        parts = []
        for k in range(len(problem.captures)):
            here = problem.pixels(k, Space(()), np.zeros(0))
            parts.append(problem.derivatives(k, alone, np.zeros(alone.size), here)[0].reshape(alone.size, -1))
        signatures.append(np.concatenate(parts, axis=1).T)
    smallest = 1.0
    for i, first in enumerate(signatures):
        for second in signatures[i + 1 :]:
            smallest = min(smallest, part_outside(first, second), part_outside(second, first))
    return smallest


CONFIRM = (
    " Confirm with a full Mueller capture: linear Stokes cannot test that the three other processes are equal, and so "
    "small a residual may come from that alone."
)
#: What a linear Stokes camera cannot tell from a small effect: that the three other processes are not equal.
DEGENERACY = "not_triply_degenerate"


class SurfaceDiagnosis(Diagnosis):
    """Result of `diagnose --reflectance`."""

    correction: Correction
    material: str
    constants: dict[str, float]
    quantities_before: tuple[SurfaceQuantities, ...]
    quantities_after: tuple[SurfaceQuantities, ...]
    xi0_change: tuple[float, ...]


@dataclass(frozen=True)
class SurfaceJudged:
    """The diagnosis, and before and after for the report."""

    diagnosis: SurfaceDiagnosis
    found: Solution


def diagnose_surface(problem: SurfaceProblem, material: str, say: Say) -> SurfaceJudged:
    """Search, test what is left, and judge."""
    search = OwnMinima(problem, say)
    likeliest, nothing = search.run(), search.at(frozenset())
    say("testing what is left over")
    before, at_best = (_tests(problem, v.space, v.fit.values) for v in (nothing, likeliest))
    here, named = nothing, tuple[Cause, ...]()
    if _explains(likeliest.space.candidates, before, at_best):
        here, named = named_causes(search, likeliest)
    solved = solution(problem, search, here)
    after = _tests(problem, solved.space, solved.fit.values)
    if not _explained_by_few(named, before, after):
        here, named, solved, after = nothing, (), solved.undone, before
    judgement = Judgement(
        named=bool(named),
        sure=bool(named),
        structure=any(beyond_chance(tests) for tests in after),
        seen=bool(would_be_seen(search.posterior(nothing))),
        figures=checks(problem, solved),
        chances=chances(problem, solved, here.covariance),
    )
    kept = judgement.kept(solved, bool(named))
    found = _Found(likeliest, here, named, solved, kept, before, after)
    return _told(problem, material, search, judgement, found=found)


@dataclass(frozen=True)
class _Found:
    """The likeliest set, the one that is named and its causes; its correction, and what of it is applied.

    `before`, `after` : tests of each capture without and with the correction, whether or not it is applied.
    """

    likeliest: Visited
    here: Visited
    named: tuple[Cause, ...]
    solved: Solution
    kept: Solution
    before: Sequence[dict[str, float]]
    after: Sequence[dict[str, float]]


def _told(
    problem: SurfaceProblem,
    material: str,
    search: OwnMinima,
    judgement: Judgement,
    *,
    found: _Found,
) -> SurfaceJudged:
    kept, named, verdict, captures = found.kept, found.named, judgement.verdict, range(len(problem.captures))
    ranking = _ranking(search)
    rivals = [c for cause in named if cause.alternatives for c in (*cause.candidates, *cause.alternatives)]
    first, last = (
        [quantities(problem, k, space, fit.values) for k in captures]
        for space, fit in ((kept.base, kept.before_fit), (kept.space, kept.fit))
    )
    in_doubt = _degeneracy_in_doubt(problem, found.solved)
    effects = _effects(problem, found, in_doubt)
    diagnosis = SurfaceDiagnosis(
        verdict=verdict,
        error_before=_error(problem, kept.before),
        error_after=_error(problem, kept.after),
        noise_floor_percent=100 * noise_floor(problem),
        effects=effects,
        unobservable=_unobservable(search, found.here),
        recommendation=wanted_for_evidence(problem)
        if verdict == "undetermined"
        else recommended(problem, kept.space, kept.fit, rivals, verdict=verdict, before=found.before)
        + (CONFIRM if named and in_doubt else ""),
        unexplained=_unexplained(problem, found.likeliest, found.after, ranking)
        if verdict in ("unexplained", "partly_explained")
        else None,
        calibrated={},
        ranking=ranking,
        captures=tuple(_capture(problem, k, found.before[k], found.after[k]) for k in captures),
        instrument=problem.model.name,
        wavelengths_nm=(problem.captures[0].wavelength_nm,),
        simulated=any(c.simulated for c in problem.captures),
        correction=Correction(
            effects=tuple(_applied(problem, e) for e in effects), checks=judgement.checks, refused=judgement.refused
        ),
        material=material,
        constants=constants(problem, kept.space, kept.fit.values),
        quantities_before=tuple(q for q, _ in first),
        quantities_after=tuple(q for q, _ in last),
        xi0_change=tuple(rmsd(b[np.isfinite(b)]) for b in (y - x for (_, x), (_, y) in zip(first, last, strict=True))),
    )
    return SurfaceJudged(diagnosis, kept)


def _tests(problem: SurfaceProblem, space: Space, values: Array) -> list[dict[str, float]]:
    return [structure(problem, k, space, values) for k in range(len(problem.captures))]


def _unexplained(
    problem: SurfaceProblem, likeliest: Visited, after: Sequence[dict[str, float]], ranking: Sequence[Ranked]
) -> Unexplained:
    lines = tuple(
        f"{data.name}: {name}, {value:.0f} standard deviations above noise"
        for data, tests in zip(problem.captures, after, strict=True)
        for name, value in beyond_chance(tests).items()
    )
    tried = tuple(c.label for c in likeliest.space.candidates) or tuple(r.candidate for r in ranking[:MOST_TRIED])
    return Unexplained(description=lines, tried=tried)


def constants(problem: SurfaceProblem, space: Space, values: Array) -> dict[str, float]:
    """n, k, a and b of the material with the effects."""
    view, (_, surface) = problem.captures[0].view, problem.changes(0, space, values)
    index = view.index + surface.index
    b = view.b * float(np.exp(surface.diffuse_log_b))
    return {"n": index.real, "k": max(index.imag, 0.0), "a": view.a + surface.diffuse_a, "b": b}


def noise_floor(problem: SurfaceProblem) -> float:
    """Rms noise over the mean signal."""
    parts = [np.mean(c.variance) / np.mean(c.y) ** 2 for c in problem.captures]
    return float(np.sqrt(np.mean(parts)))


def _explained_by_few(
    named: Sequence[Cause], before: Sequence[dict[str, float]], after: Sequence[dict[str, float]]
) -> bool:
    return len(named) <= MOST_EFFECTS and _explains([c for one in named for c in one.candidates], before, after)


def _explains(
    candidates: Sequence[Candidate], before: Sequence[dict[str, float]], after: Sequence[dict[str, float]]
) -> bool:
    """Little is left of what is smooth over the object, which noise is not."""
    share = max(
        (y[name] / max(x[name], LIMIT) for x, y in zip(before, after, strict=True) for name in x if y[name] > LIMIT),
        default=0.0,
    )
    return share <= max(LEFT_OVER, *(c.effect.rough for c in candidates), 0.0)


def _degeneracy_in_doubt(problem: SurfaceProblem, solved: Solution) -> bool:
    full = (
        rank_of(problem.rows(k, problem.changes(k, solved.base, np.zeros(0))[0])) == 16
        for k in range(len(problem.captures))
    )
    excess = solved.before.excess / max(solved.before.excess + solved.before.freedom, 1e-300)
    return not any(full) and solved.before.rms * float(np.sqrt(max(excess, 0.0))) < AS_LIKELY


def _error(problem: SurfaceProblem, out: HeldOut) -> Error:
    return Error(
        rms_percent=100 * out.rms,
        chi2_reduced=out.chi2_reduced,
        held_out=problem.held_out,
        beyond_noise=BeyondNoise.of(out.excess, out.freedom, 100 * noise_floor(problem)),
    )


def _effects(problem: SurfaceProblem, found: _Found, in_doubt: bool) -> tuple[FoundEffect, ...]:
    solved = found.solved
    error = standard_errors(problem, solved.space, solved.fit, found.here.state.unit)
    part = dict(solved.space.pairs)
    doubt = (DEGENERACY,) if in_doubt else ()
    return tuple(
        FoundEffect(
            kind=candidate.kind,
            element=candidate.place or None,
            parameters=parameters_of(candidate, solved.fit.values[part[candidate]], error[part[candidate]]),
            evidence=2 * cause.log_odds,
            indistinguishable_from=(*dict.fromkeys(c.short for c in cause.alternatives), *doubt),
            scope="instrument",
            removal_chance=1 - cause.probability,
            confident=True,
            probability=cause.probability,
            answer="one of" if doubt else cause.answer,
        )
        for cause in found.named
        for candidate in cause.candidates
    )


def _applied(problem: SurfaceProblem, effect: FoundEffect) -> AppliedEffect:
    """An effect as a file stores it."""
    return AppliedEffect(
        kind=effect.kind,
        element=effect.element,
        parameters=effect.parameters,
        evidence=effect.evidence,
        captures=tuple(c.name for c in problem.captures),
        scope=effect.scope,
        wavelength_nm=problem.captures[0].wavelength_nm,
        indistinguishable_from=effect.indistinguishable_from,
        probability=effect.probability,
    )


def _ranking(search: OwnMinima) -> tuple[Ranked, ...]:
    """What each effect would explain by itself, the best first."""
    nothing = search.at(frozenset())
    unit = nothing.state.unit
    start = nothing.score_at(unit)
    alone = [(v.score_at(unit) - start, v) for v in search.visited.values() if len(v.groups) == 1]
    return tuple(
        Ranked(candidate=v.space.candidates[0].label, evidence=round(2 * odds, 1), rms_percent=100 * v.fit.rms)
        for odds, v in sorted(alone, key=lambda item: -item[0])[:MOST_RANKED]
    )


def _unobservable(search: OwnMinima, here: Visited) -> tuple[str, ...]:
    """Effects about which the captures say nothing beside what was found; without it the normal is hardly known."""
    sets, state = search.beside(here)
    told = sets.given_others(state)
    return tuple(
        candidate.short
        for g, (curvature, _) in told.items()
        if g not in here.groups and np.all(np.diag(curvature) * state.unit < SEEN)
        for candidate in search.candidates_of(g)
    )


def _capture(problem: SurfaceProblem, k: int, before: dict[str, float], after: dict[str, float]) -> CaptureReport:
    data = problem.captures[k]
    return CaptureReport(
        name=data.name,
        sample=f"triply degenerate, xi0 and M00 free at each of {len(data.y)} pixels",
        simulated=data.simulated,
        noise=data.noise,
        binned=1,
        clipped_fraction=data.clipped_fraction,
        tests_before=before,
        tests_after=after,
    )


@one_blas_thread()
def diagnose_object(
    captures: Sequence[Path],
    model: InstrumentModel,
    material: Any,
    view: ViewingGeometry,
    *,
    say: Say = lambda line: None,
) -> tuple[SurfaceJudged, SurfaceProblem]:
    """Diagnose captures of one object jointly.

    Parameters
    ----------
    captures : of one instrument at one wavelength; several arm angles are best.
    model : instrument, as loaded from its file.
    material : reflectance model; view : geometry.

    Raises
    ------
    ProcessError : a capture cannot be used (arm angle, noise, object out of view), a material that cannot be bent.
    CaptureError : captures of several wavelengths.
    """
    data: list[SurfaceData] = []
    for path in captures:
        say(f"reading {path.name}")
        with Capture(path) as capture:
            data.append(read_surface(capture, model.at(capture.header.wavelength_nm), view, material))
    wavelengths = {c.wavelength_nm for c in data}
    if len(wavelengths) != 1:
        found = ", ".join(f"{w:g}" for w in sorted(wavelengths))
        raise CaptureError(f"the captures are at {found} nm; effects differ with wavelength. Give one wavelength.")
    problem = SurfaceProblem(model.at(wavelengths.pop()), data)
    return diagnose_surface(problem, material.name, say), problem
