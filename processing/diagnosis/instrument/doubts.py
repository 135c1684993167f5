"""Why a name is doubted although the evidence for its pattern is large."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from processing.diagnosis.instrument.edges import at_edges
from processing.diagnosis.instrument.nameless import STANDS_OUT, Nameless
from processing.diagnosis.instrument.nameless_effects import ImageLag, JumpOfTheSource, TurningSample, WaveOfAPlate
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.source_patterns import beat_explains_as_well, chance_of_pattern, patterned
from processing.diagnosis.instrument.unevenness import Evenness
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause, shown
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import (
    BOUND,
    CHANCE_OF_PATTERN,
    EDGES,
    LIMIT,
    ONE_PATTERN,
    TESTABLE,
    TIMES,
    UNEVEN,
    UNEVEN_SHARE,
    UNKNOWN_NOISE,
)
from processing.diagnosis.search.solution import Solution
from processing.instrument.effects.base import (
    CountsEffect,
    FieldEffect,
    GeneralEffect,
    ImageShift,
    InstrumentEffect,
    PointwiseEffect,
    SourceEffect,
    ValuePerState,
)

#: The reason for which values for each state are not used either, where an unknown sample takes up a part of them: what
#: it takes up is then not like the rest, as it is with random values.
PATTERN = "its values follow one wave or jump over the states, as a beat or a fringe does: they are not random"
#: The same of an effect in whose place a source with one wave fits better, or as well with a frequency of its own.
BEAT = "a source that beats explains as much as it does"
#: The same where a plate that turns has a wave of its own that is not in the list.
WAVE = "a plate that changes two to four times a turn explains more than it does"
#: Here either may be the truth: it is not used, and what stands beside both is.
WAVE_AS_WELL = "a plate that changes two to four times a turn explains as much as it does"
#: The same of a sample that turns on its stage; nothing that is found beside it need be of the instrument.
TURN = "a sample that turns during the capture explains more than it does"
TURN_AS_WELL = "a sample that turns during the capture explains as much as it does"
#: The same of a detector that has not read all of a frame when the next one comes.
LAG = "a part of each frame that is read with the next one explains more than it does"
LAG_AS_WELL = "a part of each frame that is read with the next one explains as much as it does"
#: The same of a lamp that jumps once.
JUMP = "a source that jumps once explains more than it does"
JUMP_AS_WELL = "a source that jumps once explains as much as it does"
#: For each, the gain in chi-square from which on it explains more, and the reasons. That the sample turned, of which
#: all else may be a part, has to be sure; so has a wave of a plate, of which there are as many as plates and harmonics.
IN_ITS_PLACE = {
    WaveOfAPlate: (STANDS_OUT, WAVE, WAVE_AS_WELL),
    TurningSample: (STANDS_OUT, TURN, TURN_AS_WELL),
    ImageLag: (0.0, LAG, LAG_AS_WELL),
    JumpOfTheSource: (0.0, JUMP, JUMP_AS_WELL),
}
#: The image does not move where that would be seen best.
STANDS = "the edges, which were left out of the fit, do not move as it says"
#: Optics and mechanics are the same for the whole image.
NOT_ALIKE = "it differs from part to part of the image, which nothing in the train does"
#: Reasons that say that something else is there, of which what the cause explains is left over.
ELSE = (PATTERN, BEAT, WAVE, TURN, LAG, JUMP, STANDS, NOT_ALIKE)
#: Reasons that say that either may be there.
AS_WELL = (WAVE_AS_WELL, TURN_AS_WELL, LAG_AS_WELL, JUMP_AS_WELL)
#: The reason of a source beside one that follows a pattern: where that is not used, neither is this.
BESIDE_PATTERN = "it may be a part of a source that changes as no effect of the list does"
#: The reason for which nothing is written for later captures: the sample or its light changed, and what is found beside
#: that may be a part of it.
OF_THE_SAMPLE = "it differs from part to part of the image, which a source does not"
CHANGED = (OF_THE_SAMPLE, TURN)
#: The one reason that leaves a name likely.
PART_OF_LEFT = "it may be a part of what is left unexplained"


def doubts(
    problem: InstrumentProblem, found: Posterior, solved: Solution, causes: Sequence[Cause], left: float
) -> dict[Cause, str]:
    """Reasons by cause; a cause without one may be called by its name. `left` is the chi-square of structure."""
    out: dict[Cause, str] = {}
    uneven, patterned = 0.0, set[int | None]()
    nameless = Nameless.beside(problem, found) if causes else None
    still = _standing(problem, solved, causes)
    even = Evenness(problem, solved.space, solved.fit.values)
    for cause in causes:
        reason = STANDS if cause in still else _of_itself(problem, found, solved, cause, causes, even)
        if reason is None and nameless is not None:
            reason = _in_its_place(nameless.gains_over(cause), cause)
        if reason is not None:
            out[cause] = reason
        if reason == PATTERN:
            patterned |= {c.capture for c in cause.candidates if isinstance(c.effect, SourceEffect)}
        if reason == OF_THE_SAMPLE:
            uneven = max(uneven, cause.log_odds)
    for cause in causes:
        first = cause.candidates[0]
        if cause not in out and isinstance(first.effect, SourceEffect) and first.capture in patterned:
            out[cause] = BESIDE_PATTERN
    # What follows a pattern is no effect of the list: what it took away is left over as well.
    left += sum(2 * cause.log_odds * found.samples.best.unit for cause in something_else(out))
    for rank, cause in enumerate(causes, 1):
        if problem.noise_known:
            weak = 2 * cause.log_odds * found.samples.best.unit < TIMES * rank**2 * left
        else:
            general = isinstance(cause.candidates[0].effect, GeneralEffect | PointwiseEffect)
            rest = found.sets.noise.directions if general else 0.0
            weak = cause.log_odds < max(UNKNOWN_NOISE, TIMES * rest / 2)
        if cause not in out and weak:
            out[cause] = PART_OF_LEFT
        # What is uneven is another cause, and smaller effects beside it may be parts of it.
        if cause not in out and cause.log_odds < uneven:
            out[cause] = "it may be a part of what is uneven over the image"
    return out


def something_else(doubt: Mapping[Cause, str], least: float = STANDS_OUT) -> list[Cause]:
    """Causes that are something else and explain more than `least` of chi-square.

    What hardly stands out may be chance, and what does as well in a cause's place is told.
    """
    return [cause for cause, why in doubt.items() if why in ELSE and 2 * cause.log_odds > least]


def _in_its_place(gains: Mapping[type[InstrumentEffect], float], cause: Cause) -> str | None:
    """The reason where something that has no name gains so much over a cause; of two that are as likely none is sure.

    What is told as one of several is no one name yet: a wave has to explain more than any of them, and what else there
    is has to be sure. So it has to beside values for each state, in whose place no wave is asked.
    """
    least = dict.fromkeys(IN_ITS_PLACE, -STANDS_OUT if _is_one_name(cause) else STANDS_OUT)
    if cause.others:
        least[WaveOfAPlate] = 0.0
    if isinstance(cause.candidates[0].effect, ValuePerState):
        least[WaveOfAPlate] = np.inf
    asked = {kind: gain for kind, gain in gains.items() if gain > least[kind]}
    best = max(asked, key=lambda kind: asked[kind], default=None)
    if best is None:
        return None
    from_here, more, as_well = IN_ITS_PLACE[best]
    return more if asked[best] > from_here else as_well


def _of_itself(
    problem: InstrumentProblem,
    found: Posterior,
    solved: Solution,
    cause: Cause,
    causes: Sequence[Cause],
    even: Evenness,
) -> str | None:
    """The reason that a cause gives by itself, whatever is left of the others."""
    effect = cause.candidates[0].effect
    if _at_bound(cause):
        return "a value stands at its bound: the data ask for something else"
    if isinstance(effect, ValuePerState):
        if not testable(problem, solved, cause, causes):
            return "as many values as the data have"
        return PATTERN if _one_pattern(problem, found, cause) else None
    if isinstance(effect, SourceEffect):
        return OF_THE_SAMPLE if any(_uneven(even, solved, c, cause) for c in cause.candidates) else None
    # Channels that look at places apart leave something where the image is curved: that is not alike either.
    alike = isinstance(effect, CountsEffect) or any(c.place_px is not None for c in problem.captures)
    if not alike and any(_uneven(even, solved, c, cause) for c in cause.candidates):
        return NOT_ALIKE
    return (
        BEAT if problem.noise_known and _is_one_name(cause) and beat_explains_as_well(problem, found, cause) else None
    )


def _is_one_name(cause: Cause) -> bool:
    """What is told as one of several is no name yet, and random values have no wave in their place."""
    return not cause.others and not isinstance(cause.candidates[0].effect, ValuePerState)


def _standing(problem: InstrumentProblem, solved: Solution, causes: Sequence[Cause]) -> list[Cause]:
    """Shifts of which the edges show too little: an image that moves does so at its edges too."""
    shifts = [c for c in causes if isinstance(c.candidates[0].effect, ImageShift)]
    shifts = [c for c in shifts if all(one in solved.space.candidates for one in c.candidates)]
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
    before = [c for other in causes if other is cause or other.log_odds > cause.log_odds for c in other.candidates]
    sizes = [shown(*found) for found in zip(cause.values, cause.covariance, strict=True)]
    least = min(1.0, max(sizes))
    excess = max(solved.before.excess, 0.0)
    values, directions, shows = [], [], []
    for k, ((free, power), nm) in enumerate(zip(problem.powers(), problem.wavelengths_nm, strict=True)):
        seen = excess * power / power.sum()
        directions.append(free * max(1.0, float(np.sum(seen / (1 + seen)))) if problem.noise_known else free)
        values.append(sum(c.size for c in before if isinstance(c.effect, ValuePerState) and c.acts(k, nm)))
        shows.append(
            any(size >= least and c.acts(k, nm) for size, c in zip(sizes, cause.candidates, strict=True)),
        )
    others = len(causes) - 1
    # What the captures share counts once.
    all_values = sum(c.size for c in before if isinstance(c.effect, ValuePerState))
    return bool(
        all_values + others < TESTABLE * sum(directions)
        or np.any((np.array(values) + others < TESTABLE * np.array(directions)) & shows)
    )


def _at_bound(cause: Cause) -> bool:
    for candidate, values in zip(cause.candidates, cause.values, strict=True):
        width = candidate.upper - candidate.lower
        if np.any(np.minimum(values - candidate.lower, candidate.upper - values) < BOUND * width):
            return True
    return False


def _one_pattern(problem: InstrumentProblem, found: Posterior, cause: Cause) -> bool:
    typical = found.space.joined("typical")
    part = dict(zip(found.space.candidates, found.space.slices, strict=True))
    seen = []
    for candidate, values, covariance in zip(cause.candidates, cause.values, cause.covariance, strict=True):
        p = part[candidate]
        curvature = found.sets.form.curvature[p, p] / np.outer(typical[p], typical[p]) / found.samples.best.unit
        seen.append(patterned(values, curvature, covariance))
    beyond = sum(one.beyond_noise for one in seen)
    if beyond <= sum(one.noise for one in seen):
        return False
    if any(acts_on_unknown(problem, c) for c in cause.candidates):
        return chance_of_pattern(seen) < CHANCE_OF_PATTERN
    return sum(one.held for one in seen) > ONE_PATTERN * beyond


def acts_on_unknown(problem: InstrumentProblem, candidate: Candidate) -> bool:
    """Whether the candidate acts on a capture of an unknown sample."""
    return any(c.sample is None and candidate.acts(k, c.wavelength_nm) for k, c in enumerate(problem.captures))


def _uneven(even: Evenness, solved: Solution, candidate: Candidate, cause: Cause) -> bool:
    """A source, or a train, that changes does so alike in the whole image; what differs from part to part is none."""
    if candidate not in solved.space.candidates or any(isinstance(c.effect, FieldEffect) for c in solved.effects):
        return False
    excess, terms = even.varies(candidate)
    return bool(excess > max(UNEVEN * np.sqrt(2 * terms), UNEVEN_SHARE * 2 * cause.log_odds))
