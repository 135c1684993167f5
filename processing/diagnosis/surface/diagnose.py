"""Diagnose captures of an object against a reflectance model: posterior, names, verdict, and what a correction does."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from processing.arrays import Array
from processing.computing.blas import one_blas_thread
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Names, causes, observable_effects, with_parts
from processing.diagnosis.search.correction import solution
from processing.diagnosis.search.decision import Judgement, beyond_chance, in_words
from processing.diagnosis.search.fit import Fit, Solution
from processing.diagnosis.search.posterior import Posterior, Say, fit_posterior
from processing.diagnosis.search.range_of import least_apart, rank_of
from processing.diagnosis.search.result import CaptureReport, Correction, Diagnosis
from processing.diagnosis.search.rules import APART, GROWTH, LIKELY, LIMIT, SHOWN
from processing.diagnosis.search.space import Space
from processing.diagnosis.surface.data import SurfaceData, read_surface
from processing.diagnosis.surface.problem import OF_INSTRUMENT, SurfaceProblem, structure
from processing.diagnosis.surface.quantities import SurfaceQuantities, chances, quantities
from processing.diagnosis.verdict.answer import Answer, checks, error, unobservable
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import InstrumentModel
from processing.polarization.image_difference import rmsd
from processing.storage.captures.capture import Capture, CaptureError

#: [of the signal] Structure up to which a linear Stokes camera cannot tell an effect from small eigenvalues that are
#: not equal: apart by what the paper saw (9 % at 451 nm, 3 % at 662 nm) they leave 0.1 to 2 % on the simulated sphere.
AS_LIKELY = 0.015
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
    solution: Solution


def diagnose_surface(problem: SurfaceProblem, material: str, say: Say) -> SurfaceJudged:
    """Find the posterior, test what is left, guard the correction, and name causes."""
    space = Space(problem.pool())
    posterior = fit_posterior(problem, space, (), [np.zeros(space.size)], say=say)
    say("testing what is left over")
    solved, captures = solution(problem, posterior, Space(()), np.zeros(0)), range(len(problem.captures))
    posterior, covariance, wider = widen_errors(problem, posterior, solved)
    (before, _), (after, excess) = (
        zip(*(structure(problem, k, at, fit.values) for k in captures), strict=True) for at, fit in solved.ends
    )
    has_structure = any(map(beyond_chance, after))
    names = names_of(posterior, wider, sum(excess) if has_structure else 0.0)
    judgement = Judgement(
        named=bool(names.named),
        sure=bool(names.named),
        structure=has_structure,
        observable=bool(observable_effects(posterior)),
        figures=checks(problem, solved),
        chances=chances(problem, solved, covariance),
    )
    answer = Answer(problem, posterior, solved, names, judgement)
    return SurfaceJudged(_report(answer, problem, material, before=before, after=after), answer.applied)


def names_of(posterior: Posterior, wider: Array, chi2: float) -> Names:
    """Likely causes without those that may be something else; `chi2` is that of structure.

    Their errors are `wider` (K,) than slopes promise.
    """
    likely, part = [c for c in causes(posterior, chi2) if c.probability >= LIKELY], dict(posterior.space.pairs)
    doubt = with_parts(posterior, likely, {}, chi2=chi2, noise_known=True)
    named = []
    for cause in (c for c in likely if c not in doubt):
        factors = [np.outer(wider[part[c]], wider[part[c]]) for c in cause.candidates]
        widened = tuple(v * f for v, f in zip(cause.covariance, factors, strict=True))
        named.append(replace(cause, covariance=widened))
    return Names(tuple(named), {})


def widen_errors(problem: SurfaceProblem, posterior: Posterior, solved: Solution) -> tuple[Posterior, Array, Array]:
    """The posterior and the covariance of the values that are corrected, as wide as the chi-square is.

    Also by how much wider each value (K,) of the posterior is.

    Slopes at one point promise less than a bent valley holds. Along each principal axis an error is a third of the way
    to where chi-square and prior have risen by nine, on the side where they rise less.
    """
    space, values, part = solved.space, solved.fit.values, dict(posterior.space.pairs)
    index = np.concatenate([np.zeros(0, dtype=np.int64), *(np.r_[part[c]] for c in space.candidates)])
    typical, lower, upper = (space.joined(name) for name in ("typical", "lower", "upper"))
    size, axes = np.linalg.eigh(posterior.covariance[np.ix_(index, index)] / np.outer(typical, typical))
    wide = np.ones(size.size)

    def rise(step: Array) -> float:
        ends = [end for end in (values + step, values - step) if np.all((lower <= end) & (end <= upper))]
        excess = [problem.sums(space, end, derivatives=False).excess.sum() for end in ends]
        # What the data do not tell is as wide as its prior.
        least = min(excess, default=np.inf) - solved.fit.excess + solved.weak @ step**2
        return max(float(least), 1e-300) / posterior.samples.best.unit

    for j in np.flatnonzero(size > 0):
        step = SHOWN * np.sqrt(size[j]) * axes[:, j] * typical
        while (missing := SHOWN / np.sqrt(rise(wide[j] * step))) > GROWTH:
            wide[j] *= min(missing, 2.0)
    covariance = posterior.covariance.copy()
    covariance[np.ix_(index, index)] = (axes * size * wide**2) @ axes.T * np.outer(typical, typical)
    wider = np.sqrt(np.diag(covariance) / np.maximum(np.diag(posterior.covariance), 1e-300))
    return replace(posterior, covariance=covariance), covariance[np.ix_(index, index)], wider


def _report(
    answer: Answer,
    problem: SurfaceProblem,
    material: str,
    *,
    before: Sequence[dict[str, float]],
    after: Sequence[dict[str, float]],
) -> SurfaceDiagnosis:
    final, names, verdict = answer.applied, answer.names, answer.judgement.verdict
    in_doubt, rivals = _degeneracy_in_doubt(problem, answer.solved), [c for each in names.rivals for c in each]

    def next_step() -> str:
        text = recommended(problem, final.space, final.fit, rivals, verdict=verdict, before=before)
        return text + (CONFIRM if names.named and in_doubt else "")

    fields = answer.fields(
        recommended=next_step,
        descriptions=[
            f"{data.name}: {line}"
            for data, tests in zip(problem.captures, after, strict=True)
            for line in in_words(tests)
        ],
        captures=[_capture(problem, k, final, before[k], after=after[k]) for k in range(len(problem.captures))],
        unseen=unobservable(problem, answer.posterior),
        calibrated={},
        lasts=True,
    )
    if in_doubt:
        more = {"answer": "one of"}
        fields["effects"] = tuple(
            e.model_copy(update=more | {"indistinguishable_from": (*e.indistinguishable_from, DEGENERACY)})
            for e in fields["effects"]
        )
    first, last = (
        [quantities(problem, k, space, fit.values) for k in range(len(problem.captures))] for space, fit in final.ends
    )
    return SurfaceDiagnosis(
        **fields,
        material=material,
        constants=constants(problem, final.space, final.fit.values),
        quantities_before=tuple(q for q, _ in first),
        quantities_after=tuple(q for q, _ in last),
        xi0_change=tuple(rmsd(b[np.isfinite(b)]) for b in (y - x for (_, x), (_, y) in zip(first, last, strict=True))),
    )


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
    if verdict == "unexplained":
        if any(tests.get(OF_INSTRUMENT, 0.0) > LIMIT for tests in before):
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
    if len(rivals) > 1 and _least_angle(problem, space, fit, rivals) >= APART:
        return "Their signatures differ: repeat the capture with more light or more frames."
    if rank_of(problem.rows(0, space, fit.values)) < 16:
        return "Take a full Mueller capture of the same object: one angle of polarization at each pixel is too little."
    return "Take captures at two more arm angles, at least 30 degrees apart, and diagnose them together."


def _least_angle(problem: SurfaceProblem, space: Space, fit: Fit, rivals: Sequence[Candidate]) -> float:
    """Smallest sine between the signatures of two rivals in these captures."""
    signatures = []
    for candidate in rivals:
        alone = Space((candidate,))
        parts = []
        for k in range(len(problem.captures)):
            pixels = problem.pixels(k, Space(()), np.zeros(0))
            parts.append(problem.derivatives(k, alone, np.zeros(alone.size), pixels)[0].reshape(alone.size, -1))
        signatures.append(np.concatenate(parts, axis=1).T)
    return least_apart(signatures)


def constants(problem: SurfaceProblem, space: Space, values: Array) -> dict[str, float]:
    """n, k, a and b of the material with the effects."""
    view, (_, surface) = problem.captures[0].view, problem.changes(0, space, values)
    index = view.index + surface.index
    b = view.b * float(np.exp(surface.diffuse_log_b))
    return {"n": index.real, "k": max(index.imag, 0.0), "a": view.a + surface.diffuse_a, "b": b}


def _degeneracy_in_doubt(problem: SurfaceProblem, solved: Solution) -> bool:
    full = (rank_of(problem.rows(k, solved.base, np.zeros(0))) == 16 for k in range(len(problem.captures)))
    excess = solved.before.excess / max(solved.before.excess + solved.before.freedom, 1e-300)
    return not any(full) and solved.before.rms * float(np.sqrt(max(excess, 0.0))) < AS_LIKELY


def _capture(
    problem: SurfaceProblem, k: int, applied: Solution, before: dict[str, float], *, after: dict[str, float]
) -> CaptureReport:
    data = problem.captures[k]
    return CaptureReport(
        name=data.name,
        sample=f"triply degenerate, xi0 and M00 free at each of {len(data.y)} pixels",
        simulated=data.simulated,
        noise=data.noise,
        binned=1,
        clipped_fraction=data.clipped_fraction,
        error_before=error(problem, applied.undone, applied.before.of(k), k),
        error_after=error(problem, applied, applied.after.of(k), k),
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
        listed = ", ".join(f"{w:g}" for w in sorted(wavelengths))
        raise CaptureError(f"the captures are at {listed} nm; effects differ with wavelength. Give one wavelength.")
    problem = SurfaceProblem(model.at(wavelengths.pop()), data)
    return diagnose_surface(problem, material.name, say), problem
