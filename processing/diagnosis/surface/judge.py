"""From the search in the reflectance to a verdict, and what the correction does to psi, |D| and xi0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.outcome import Found
from processing.diagnosis.search.result import (
    CaptureReport,
    Diagnosis,
    Error,
    FoundEffect,
    Ranked,
    Unexplained,
    Verdict,
)
from processing.diagnosis.search.search import CHANCE, Say
from processing.diagnosis.search.space import Space
from processing.diagnosis.surface.problem import SurfaceProblem
from processing.diagnosis.surface.quantities import Quantities, quantities
from processing.diagnosis.surface.recommend import recommended
from processing.diagnosis.surface.search import SurfaceSearch, roughness
from processing.diagnosis.surface.standard_errors import standard_errors
from processing.instrument.model import EffectParameter
from processing.polarization.image_difference import rmsd

CONFIRM = (
    " Confirm with a full Mueller capture: linear Stokes cannot test that the three other processes are equal, and so "
    "small a residual may come from that alone."
)
#: Standard deviations beyond which a test says "structure".
LIMIT = 5.0
#: Share of every test's excess that must be explained before anything is named while structure is left.
SHARE = 0.97
#: Information, in chi-square for a typical size, below which an effect cannot be seen.
SEEN = 4.0
#: What a linear Stokes camera cannot tell from a small effect: that the three other processes are not equal.
DEGENERACY = "not_triply_degenerate"
#: Structure over the mean signal up to which that is as likely: small eigenvalues apart by what the paper saw (9 % at
#: 451 nm, 3 % at 662 nm) leave 0.1 to 2 % on the simulated sphere, more at larger arm angles.
AS_LIKELY = 0.015
#: More effects than this at once are not an explanation.
MOST_EFFECTS = 3


class SurfaceDiagnosis(Diagnosis):
    """Result of `diagnose --reflectance`."""

    material: str
    constants: dict[str, float]
    quantities_before: tuple[Quantities, ...]
    quantities_after: tuple[Quantities, ...]
    xi0_change: tuple[float, ...]


@dataclass(frozen=True)
class SurfaceJudged:
    """The diagnosis and what the report draws."""

    diagnosis: SurfaceDiagnosis
    found: Found


def diagnose_surface(problem: SurfaceProblem, material: str, say: Say) -> SurfaceJudged:
    """Search, test what is left, and judge."""
    search = SurfaceSearch(problem, say)
    found = search.run()
    say("testing what is left over")
    captures = range(len(problem.captures))
    none = np.zeros(0)
    before = [structure(problem, k, found.base, none) for k in captures]
    after = [structure(problem, k, found.space, found.fit.values) for k in captures]
    verdict = _verdict(found, before, after)
    tried: tuple[Candidate, ...] = ()
    if verdict == "unexplained":
        tried = found.effects or tuple(t.candidate for t in found.ranking[:5])
        found.space, found.fit, found.after, after = found.base, found.before_fit, found.before, before
    rivals = [c for e in found.effects for c in (e, *found.sets.get(e, ())) if found.sets.get(e)]
    lines = tuple(
        f"{problem.captures[k].name}: {name}, {value:.0f} standard deviations above noise"
        for k in captures
        for name, value in after[k].items()
        if value > LIMIT
    )
    first = [quantities(problem, k, found.base, none) for k in captures]
    last = [quantities(problem, k, found.space, found.fit.values) for k in captures]
    diagnosis = SurfaceDiagnosis(
        verdict=verdict,
        error_before=_error(problem, found.before.rms, found.before.chi2_reduced),
        error_after=_error(problem, found.after.rms, found.after.chi2_reduced),
        noise_floor_percent=100 * noise_floor(problem),
        effects=_effects(problem, search, found),
        unobservable=_unobservable(found),
        recommendation=recommended(problem, found.space, found.fit, rivals, verdict, before)
        + (CONFIRM if found.effects and _degeneracy_in_doubt(problem, found) else ""),
        unexplained=None
        if verdict in ("consistent", "explained")
        else Unexplained(description=lines, tried=tuple(c.label for c in tried), empirical=None),
        calibrated={},
        ranking=tuple(
            Ranked(candidate=t.candidate.label, evidence=round(t.evidence, 1), rms_percent=100 * t.out.rms)
            for t in found.ranking[:10]
        ),
        captures=tuple(_capture(problem, k, before[k], after[k]) for k in captures),
        instrument=problem.model.name,
        wavelengths_nm=(problem.captures[0].wavelength_nm,),
        simulated=any(c.simulated for c in problem.captures),
        material=material,
        constants=constants(problem, found.space, found.fit.values),
        quantities_before=tuple(q for q, _ in first),
        quantities_after=tuple(q for q, _ in last),
        xi0_change=tuple(rmsd(b[np.isfinite(b)]) for b in (y - x for (_, x), (_, y) in zip(first, last, strict=True))),
    )
    return SurfaceJudged(diagnosis, found)


def structure(problem: SurfaceProblem, k: int, space: Space, values: Array) -> dict[str, float]:
    """Tests of a capture's residual: name to standard deviations from what noise gives.

    Sums over tiles of the object, split into what some Mueller matrix could cause and what none could, which speaks
    against the instrument's model and not against the reflectance.
    """
    here, data = problem.pixels(k, space, values), problem.captures[k]
    r, noise = here.residual, problem.noise[k] * here.free
    out = {"sum of squares": float((np.sum(r**2) - noise.sum()) / np.sqrt(2 * noise.sum()))}
    w = problem.rows(k, problem.changes(k, space, values)[0]) / np.mean(problem.sigma[k], axis=0)[:, None]
    u, size, _ = np.linalg.svd(w, full_matrices=False)
    basis = u[:, size > 1e-8 * size[0]]
    rows, rank = basis.shape
    tiles = np.unique(data.tile)
    totals = np.stack([r[data.tile == t].sum(axis=0) for t in tiles])
    level = np.array([noise[data.tile == t].sum() for t in tiles]) / (rows - 2)
    inside = np.sum((totals @ basis) ** 2)
    for name, square, directions in (
        ("smooth over the object", inside, rank - 2),
        ("smooth over the object, of the instrument", np.sum(totals**2) - inside, rows - rank),
    ):
        if directions > 0:
            out[name] = float((square - directions * level.sum()) / np.sqrt(2 * directions * np.sum(level**2)))
    return out


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


def _verdict(found: Found, before: Sequence[dict[str, float]], after: Sequence[dict[str, float]]) -> Verdict:
    left = any(value > LIMIT for tests in after for value in tests.values())
    if not found.effects:
        return "unexplained" if left else "consistent"
    if len(found.effects) > MOST_EFFECTS:
        return "unexplained"
    if not left:
        return "explained"
    # Of what is smooth over the object, which noise is not.
    share = max(
        y[name] / max(x[name], LIMIT) for x, y in zip(before, after, strict=True) for name in x if y[name] > LIMIT
    )
    rough = max(roughness(c) for c in found.effects)
    sure = all(found.chance.get(c, 1.0) < CHANCE for c in found.effects)
    return "partly_explained" if share <= max(1 - SHARE, rough) and sure else "unexplained"


def _degeneracy_in_doubt(problem: SurfaceProblem, found: Found) -> bool:
    full = (
        np.linalg.matrix_rank(problem.rows(k, problem.changes(k, found.base, np.zeros(0))[0]), rtol=1e-8) == 16
        for k in range(len(problem.captures))
    )
    excess = found.before.excess / max(found.before.excess + found.before.freedom, 1e-300)
    return not any(full) and found.before.rms * float(np.sqrt(max(excess, 0.0))) < AS_LIKELY


def _error(problem: SurfaceProblem, rms: float, chi2: float) -> Error:
    return Error(rms_percent=100 * rms, chi2_reduced=chi2, held_out=problem.held_out)


def _effects(problem: SurfaceProblem, search: SurfaceSearch, found: Found) -> tuple[FoundEffect, ...]:
    spread = 1.0 + search.structure(found.after, found.space.size)
    error = standard_errors(problem, found.space, found.fit, spread)
    doubt = (DEGENERACY,) if _degeneracy_in_doubt(problem, found) else ()
    out = []
    for candidate in found.effects:
        part = found.space.slices[found.space.candidates.index(candidate)]
        rivals = dict.fromkeys(c.short for c in found.sets.get(candidate, ()))
        out.append(
            FoundEffect(
                kind=candidate.kind,
                element=candidate.place or None,
                parameters={
                    p.name: EffectParameter(value=float(v), stderr=float(s), unit=p.unit)
                    for p, v, s in zip(candidate.parameters, found.fit.values[part], error[part], strict=True)
                },
                evidence=found.evidence.get(candidate, 0.0),
                indistinguishable_from=(*rivals, *doubt),
                scope="instrument",
                removal_chance=found.chance.get(candidate, 1.0),
                confident=True,
            )
        )
    return tuple(out)


def _unobservable(found: Found) -> tuple[str, ...]:
    return tuple(
        candidate.short
        for candidate, information in found.information.items()
        if np.all(np.diag(information) * candidate.typical**2 < SEEN)
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
