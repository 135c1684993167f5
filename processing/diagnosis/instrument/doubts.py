"""Why a name is doubted although the evidence for its pattern is large."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from processing.diagnosis.instrument.edges import at_edges
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.unevenness import Evenness
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause, significance, with_parts
from processing.diagnosis.search.fit import Solution
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import EDGES, LIMIT, TESTABLE

#: The image does not move where that would be seen best.
STANDS = "the edges, which were left out of the fit, do not move as it says"
#: Optics, mechanics and detector are the same for the whole image.
NOT_ALIKE = "it differs from part to part of the image, which this effect does not"
#: The sample of a capture, or its light, changed: what that capture alone says of the instrument may be a part of that.
OF_THE_SAMPLE = "it differs from part to part of the image, which a source does not"


def doubts(
    problem: InstrumentProblem, posterior: Posterior, solved: Solution, causes: Sequence[Cause], *, chi2: float
) -> dict[Cause, str]:
    """Reasons by cause; a cause without one may be called by its name. `chi2` is that of structure."""
    reasons: dict[Cause, str] = {}
    static = _static_shifts(problem, solved, causes)
    even = Evenness(problem, solved.space, solved.fit.values)
    for cause in causes:
        reason = STANDS if cause in static else _doubt_of(problem, solved, cause, even=even)
        if reason is not None:
            reasons[cause] = reason
    return with_parts(posterior, causes, reasons, chi2=chi2, noise_known=problem.noise_known)


def _doubt_of(problem: InstrumentProblem, solved: Solution, cause: Cause, *, even: Evenness) -> str | None:
    """The reason that a cause gives by itself, whatever is left of the others."""
    effect = cause.candidates[0].effect
    # Channels that look at places apart leave something where the image is curved: that is not alike either.
    apart = any(c.place_px is not None for c in problem.captures)
    if effect.per_state or (apart and not effect.of_source):
        return None
    uneven = any(_uneven(even, solved, c) for c in cause.candidates)
    return (OF_THE_SAMPLE if effect.of_source else NOT_ALIKE) if uneven else None


def find_changed(problem: InstrumentProblem, solved: Solution, doubt: Mapping[Cause, str]) -> set[int]:
    """Captures whose sample or light changed, by the doubts of causes."""
    even = Evenness(problem, solved.space, solved.fit.values)
    causes = [cause for cause, why in doubt.items() if why == OF_THE_SAMPLE]
    uneven = [c for cause in causes for c in cause.candidates if _uneven(even, solved, c)]
    return {k for c in uneven for k, nm in enumerate(problem.wavelengths_nm) if c.acts(k, nm)}


def _static_shifts(problem: InstrumentProblem, solved: Solution, causes: Sequence[Cause]) -> list[Cause]:
    """Shifts of which the edges show too little: an image that moves does so at its edges too."""
    shifts = [c for c in causes if c.candidates[0].moves_image]
    shifts = [c for c in shifts if all(candidate in solved.space.candidates for candidate in c.candidates)]
    if not shifts or not problem.noise_known:
        return []
    edges = at_edges(problem, solved.space, solved.fit.values, [c.candidates for c in shifts])
    most = edges.share + LIMIT * edges.error
    return [c for c, share in zip(shifts, most, strict=True) if share < EDGES or edges.explained < EDGES]


def testable(problem: InstrumentProblem, solved: Solution, cause: Cause, causes: Sequence[Cause]) -> bool:
    """Values for each state are fewer than the directions in which the data could show something else.

    In all captures together, where something else would show in others, or in one by itself in which they show; with
    those of other causes that are more certain: what hardly takes part does not make them as many as the data.
    """
    before = [c for rival in causes if rival is cause or rival.log_odds > cause.log_odds for c in rival.candidates]
    sizes = [significance(*entry) for entry in zip(cause.values, cause.covariance, strict=True)]
    least = min(1.0, max(sizes))
    excess = max(solved.before.excess, 0.0)
    values, directions, shows = [], [], []
    for k, ((free, power), nm) in enumerate(zip(problem.powers(), problem.wavelengths_nm, strict=True)):
        ratio = excess * power / power.sum()
        directions.append(free * max(1.0, float(np.sum(ratio / (1 + ratio)))) if problem.noise_known else free)
        values.append(sum(c.size for c in before if c.effect.per_state and c.acts(k, nm)))
        shows.append(
            any(size >= least and c.acts(k, nm) for size, c in zip(sizes, cause.candidates, strict=True)),
        )
    other_count = len(causes) - 1
    # What the captures share counts once.
    all_values = sum(c.size for c in before if c.effect.per_state)
    return bool(
        all_values + other_count < TESTABLE * sum(directions)
        or np.any((np.array(values) + other_count < TESTABLE * np.array(directions)) & shows)
    )


def _uneven(even: Evenness, solved: Solution, candidate: Candidate) -> bool:
    """A source, a train or a detector that changes does so alike in the whole image."""
    if candidate not in solved.space.candidates or any(c.effect.varies_over_image for c in solved.effects):
        return False
    excess, terms = even.varies(candidate)
    return bool(excess > LIMIT * np.sqrt(2 * terms))
