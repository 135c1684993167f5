"""From the search in the reflectance to a verdict, and what the correction does to psi, |D| and xi0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause
from processing.diagnosis.search.evidence import wanted_for_evidence, would_be_seen
from processing.diagnosis.search.fit import HeldOut
from processing.diagnosis.search.judge import Judgement, beyond_chance
from processing.diagnosis.search.own_minima import OwnMinima, Visited
from processing.diagnosis.search.posterior import Say
from processing.diagnosis.search.range_of import rank_of
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
from processing.diagnosis.search.rules import AS_LIKELY, LEFT_OVER, LIMIT, MOST_EFFECTS, MOST_RANKED, MOST_TRIED, SEEN
from processing.diagnosis.search.solution import Solution
from processing.diagnosis.search.space import Space
from processing.diagnosis.search.stored import parameters_of
from processing.diagnosis.surface.guard import chances, checks
from processing.diagnosis.surface.naming import named_causes, roughness, solution
from processing.diagnosis.surface.problem import SurfaceProblem
from processing.diagnosis.surface.quantities import Quantities, quantities
from processing.diagnosis.surface.recommend import recommended
from processing.diagnosis.surface.standard_errors import standard_errors
from processing.diagnosis.surface.structure import structure
from processing.instrument.model import AppliedEffect
from processing.polarization.image_difference import rmsd

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
    quantities_before: tuple[Quantities, ...]
    quantities_after: tuple[Quantities, ...]
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
    return _told(problem, material, search, judgement, found)


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
        else recommended(problem, kept.space, kept.fit, rivals, verdict, found.before)
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
    return Unexplained(description=lines, tried=tried, empirical=None)


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
    return share <= max(LEFT_OVER, *(roughness(c) for c in candidates), 0.0)


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
    part = dict(zip(solved.space.candidates, solved.space.slices, strict=True))
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
