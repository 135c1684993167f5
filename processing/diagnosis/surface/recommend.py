"""Which further capture of the object would tell apart what these captures cannot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import Fit
from processing.diagnosis.search.range_of import part_outside, rank_of
from processing.diagnosis.search.rules import APART, LIMIT
from processing.diagnosis.search.space import Space
from processing.diagnosis.surface.problem import SurfaceProblem
from processing.reflectance.effects.base import ReflectanceEffect


def recommended(
    problem: SurfaceProblem,
    space: Space,
    fit: Fit,
    rivals: Sequence[Candidate],
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
        if isinstance(candidate.effect, ReflectanceEffect) and candidate.effect.advice:
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
