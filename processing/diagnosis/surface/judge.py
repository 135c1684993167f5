"""From the search in the reflectance to a verdict, and what the correction does to psi, |D| and xi0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause
from processing.diagnosis.search.own_minima import OwnMinima, Visited
from processing.diagnosis.search.posterior import Say
from processing.diagnosis.search.result import (
    CaptureReport,
    Diagnosis,
    Error,
    FoundEffect,
    Ranked,
    Unexplained,
    Verdict,
)
from processing.diagnosis.search.rules import AS_LIKELY, LEFT_OVER, LIMIT, MOST_EFFECTS, SEEN
from processing.diagnosis.search.solution import Solution
from processing.diagnosis.search.space import Space
from processing.diagnosis.search.stored import parameters_of
from processing.diagnosis.surface.naming import named_causes, roughness, solution
from processing.diagnosis.surface.problem import SurfaceProblem
from processing.diagnosis.surface.quantities import Quantities, quantities
from processing.diagnosis.surface.recommend import recommended
from processing.diagnosis.surface.standard_errors import standard_errors
from processing.diagnosis.surface.structure import structure
from processing.polarization.image_difference import rmsd

CONFIRM = (
    " Confirm with a full Mueller capture: linear Stokes cannot test that the three other processes are equal, and so "
    "small a residual may come from that alone."
)
#: What a linear Stokes camera cannot tell from a small effect: that the three other processes are not equal.
DEGENERACY = "not_triply_degenerate"


class SurfaceDiagnosis(Diagnosis):
    """Result of `diagnose --reflectance`."""

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
    captures = range(len(problem.captures))
    likeliest, nothing = search.run(), search.at(frozenset())
    say("testing what is left over")
    before, at_best = ([structure(problem, k, v.space, v.fit.values) for k in captures] for v in (nothing, likeliest))
    here, named = nothing, tuple[Cause, ...]()
    if _explains(likeliest.space.candidates, before, at_best):
        here, named = named_causes(search, likeliest)
    solved = solution(problem, search, here)
    after = [structure(problem, k, solved.space, solved.fit.values) for k in captures]
    verdict = _verdict(named, before, after)
    ranking = _ranking(search)
    tried: tuple[str, ...] = ()
    if verdict == "unexplained":
        tried = tuple(c.label for c in likeliest.space.candidates) or tuple(r.candidate for r in ranking[:5])
        named, after = (), before
        solved = Solution(solved.base, solved.before_fit, solved.before, solved.base, solved.before_fit, solved.before)
    rivals = [c for cause in named if cause.alternatives for c in (*cause.candidates, *cause.alternatives)]
    lines = tuple(
        f"{problem.captures[k].name}: {name}, {value:.0f} standard deviations above noise"
        for k in captures
        for name, value in after[k].items()
        if value > LIMIT
    )
    first, last = (
        [quantities(problem, k, space, fit.values) for k in captures]
        for space, fit in ((solved.base, solved.before_fit), (solved.space, solved.fit))
    )
    in_doubt = _degeneracy_in_doubt(problem, solved)
    diagnosis = SurfaceDiagnosis(
        verdict=verdict,
        error_before=_error(problem, solved.before.rms, solved.before.chi2_reduced),
        error_after=_error(problem, solved.after.rms, solved.after.chi2_reduced),
        noise_floor_percent=100 * noise_floor(problem),
        effects=_effects(problem, solved, named, here.state.unit, in_doubt),
        unobservable=_unobservable(search, here),
        recommendation=recommended(problem, solved.space, solved.fit, rivals, verdict, before)
        + (CONFIRM if named and in_doubt else ""),
        unexplained=None
        if verdict in ("consistent", "explained")
        else Unexplained(description=lines, tried=tried, empirical=None),
        calibrated={},
        ranking=ranking,
        captures=tuple(_capture(problem, k, before[k], after[k]) for k in captures),
        instrument=problem.model.name,
        wavelengths_nm=(problem.captures[0].wavelength_nm,),
        simulated=any(c.simulated for c in problem.captures),
        material=material,
        constants=constants(problem, solved.space, solved.fit.values),
        quantities_before=tuple(q for q, _ in first),
        quantities_after=tuple(q for q, _ in last),
        xi0_change=tuple(rmsd(b[np.isfinite(b)]) for b in (y - x for (_, x), (_, y) in zip(first, last, strict=True))),
    )
    return SurfaceJudged(diagnosis, solved)


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


def _verdict(named: Sequence[Cause], before: Sequence[dict[str, float]], after: Sequence[dict[str, float]]) -> Verdict:
    left = any(value > LIMIT for tests in after for value in tests.values())
    if not named:
        return "unexplained" if left else "consistent"
    if len(named) > MOST_EFFECTS or not _explains([c for cause in named for c in cause.candidates], before, after):
        return "unexplained"
    return "partly_explained" if left else "explained"


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
        np.linalg.matrix_rank(problem.rows(k, problem.changes(k, solved.base, np.zeros(0))[0]), rtol=1e-8) == 16
        for k in range(len(problem.captures))
    )
    excess = solved.before.excess / max(solved.before.excess + solved.before.freedom, 1e-300)
    return not any(full) and solved.before.rms * float(np.sqrt(max(excess, 0.0))) < AS_LIKELY


def _error(problem: SurfaceProblem, rms: float, chi2: float) -> Error:
    return Error(rms_percent=100 * rms, chi2_reduced=chi2, held_out=problem.held_out)


def _effects(
    problem: SurfaceProblem, solved: Solution, named: Sequence[Cause], unit: float, in_doubt: bool
) -> tuple[FoundEffect, ...]:
    error = standard_errors(problem, solved.space, solved.fit, unit)
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
        for cause in named
        for candidate in cause.candidates
    )


def _ranking(search: OwnMinima) -> tuple[Ranked, ...]:
    """What each effect would explain by itself, the best first."""
    nothing = search.at(frozenset())
    unit = nothing.state.unit
    start = nothing.score_at(unit)
    alone = [(v.score_at(unit) - start, v) for v in search.visited.values() if len(v.groups) == 1]
    return tuple(
        Ranked(candidate=v.space.candidates[0].label, evidence=round(2 * odds, 1), rms_percent=100 * v.fit.rms)
        for odds, v in sorted(alone, key=lambda item: -item[0])[:10]
    )


def _unobservable(search: OwnMinima, here: Visited) -> tuple[str, ...]:
    """Effects about which the captures say nothing beside what was found; without it the normal is hardly known."""
    sets, state = search.beside(here)
    told = sets.given_others(state)
    return tuple(
        candidate.short
        for g, (curvature, _) in told.items()
        if g not in here.groups and np.all(np.diag(curvature) * state.unit < SEEN)
        for candidate in search.members[g]
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
