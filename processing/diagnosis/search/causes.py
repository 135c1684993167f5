"""Names: the groups that are causes, their probabilities, alternatives and doubts, and the observable effects.

A correction improves predictions, a name states a cause. Groups with parallel signatures, after projection of all
other effects, are one class. It can be certain that one of them is present, and open which one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import LIKELY, LIMIT, NEEDED, NOMINAL_TAU, SHOWN, SURE, TIMES
from processing.diagnosis.search.space import Problem

#: [log odds] By which one of two causes has to be likelier for a sure name.
LEAST_DIFFERENCE = float(logit(SURE))

#: Reasons that leave a name likely.
PART_OF_LEFT = "it may be a part of what is left unexplained"
PART_OF_UNLISTED = "it may be a part of the fault that has no name"
OPEN_WIRING = "another wiring, or a far value of the train, fits nearly as well"
PARTS = (PART_OF_LEFT, PART_OF_UNLISTED, OPEN_WIRING)

Answer = Literal["sure", "likely", "one of", "unlisted", "unknown"]


@dataclass(frozen=True, eq=False)
class Cause:
    """A group that is probably there.

    Attributes
    ----------
    candidates : the group's, one for each capture where it differs from capture to capture.
    values, covariance : of each candidate, if this one of the class is there.
    probability : that one of the class is there; `alternatives` stand for the others.
    log_odds : of being there, given everything else.
    """

    candidates: tuple[Candidate, ...]
    values: tuple[Array, ...]
    covariance: tuple[Array, ...]
    probability: float
    log_odds: float
    alternatives: tuple[Candidate, ...]

    @property
    def other_effects(self) -> tuple[Candidate, ...]:
        """Alternatives that are another effect, not the same from another state on."""
        return tuple(c for c in self.alternatives if c.family != self.candidates[0].family)

    @property
    def answer(self) -> Answer:
        """Word for the cause in the answer."""
        if self.probability < LIKELY:
            return "unknown"
        if self.alternatives:
            return "one of"
        if self.candidates[0].price:
            return "unlisted"
        return "sure" if self.probability >= SURE else "likely"


def causes(posterior: Posterior, chi2: float) -> tuple[Cause, ...]:
    """Causes of the most likely set, the most certain first.

    `chi2` is that which no cause explains: a smaller difference does not separate two causes.
    """
    state, (values, covariance) = posterior.samples.best, posterior.of_likeliest()
    result = []
    for k in posterior.free_groups:
        # Odds of every group as the replacement of this one, its own included.
        others = posterior.sets.without(state, k)
        given_others = posterior.sets.conditional(others)
        odds = given_others.log_odds
        forgiven = forgiven_misfit(given_others.fit_gain, k, chi2 / state.unit)
        rivals = posterior.sets.free & (state.tau == 0) & (odds > max(odds[k] - LEAST_DIFFERENCE, 0.0) - forgiven)
        alternatives = [int(j) for j in np.argsort(-odds) if rivals[j]]
        alternatives += [j for j in posterior.rivals.get(k, ()) if j not in alternatives]
        parts = [posterior.space.slices[m] for m in posterior.members[k]]
        # The effect can be certain while the state from which it acts is open.
        supported = np.flatnonzero(given_others.log_factor > 0).tolist()
        of_family = (j for j in supported if posterior.label(j).family == posterior.label(k).family)
        members = list(dict.fromkeys([k, *alternatives, *of_family]))
        # The visited sets, and the odds given the likeliest set, are both too confident.
        total = float(np.logaddexp.reduce(posterior.sets.learnt_odds(given_others, others.tau > 0)[members]))
        result.append(
            Cause(
                candidates=tuple(posterior.space.candidates[m] for m in posterior.members[k]),
                values=tuple(values[p] for p in parts),
                covariance=tuple(covariance[p, p] for p in parts),
                probability=min(posterior.samples.any_of(members), float(expit(total))),
                log_odds=float(odds[k]),
                alternatives=tuple(posterior.space.candidates[posterior.members[j][0]] for j in alternatives),
            )
        )
    return tuple(sorted(result, key=lambda c: -c.log_odds))


def significance(values: Array, covariance: Array) -> float:
    """Chi-square of values (N,) over that from which on so many are not zero: three standard deviations."""
    n = values.size
    return float(values @ np.linalg.lstsq(covariance, values)[0]) / max(SHOWN**2, n + SHOWN * float(np.sqrt(2 * n)))


def forgiven_misfit(fit_gain: Array, k: int, chi2: float) -> Array:
    """Part of its misfit that is no evidence against each group (G,) as the replacement of group k, in log odds.

    What is left over excuses a fit that is worse by as much, and no model with more values: its prior counts in full.
    `chi2` is that which no cause explains, in its unit.
    """
    return np.asarray(np.clip(fit_gain[k] - fit_gain, 0.0, 0.5 * chi2))


def information(posterior: Posterior) -> tuple[Array, NDArray[np.int64]]:
    """Information (K,) about each value at its typical size, and which values are nominal ones, which are free."""
    curvature, groups = posterior.sets.form.curvature, posterior.sets.groups
    precision = np.diag(curvature).copy()
    always = np.concatenate([np.zeros(0, dtype=np.int64), *(g.index for g in groups if g.always)])
    if always.size:
        across = curvature[always]
        block = across[:, always] + np.eye(always.size) / NOMINAL_TAU**2
        precision -= np.einsum("ij,ij->j", across, np.linalg.solve(block, across))
    return precision, always


def observable_effects(posterior: Posterior) -> tuple[Candidate, ...]:
    """Effects of optics, source or surface that exceed the noise, or the residual, at a typical size."""
    precision, always = information(posterior)
    precision /= posterior.samples.best.unit
    return tuple(
        candidate
        for candidate, part in posterior.space.pairs
        if not (candidate.state_chosen or candidate.acts_on_counts)
        and not (candidate.effect.varies_over_image or candidate.effect.is_switch or candidate.effect.per_state)
        and not np.isin(part.start, always)
        and precision[part].max() > LIMIT**2
    )


def wanted_for_evidence(problem: Problem) -> str:
    """Advice where no effect of typical size is observable."""
    needed = "More light, more pixels, or states that differ more."
    if problem.noise_known:
        return needed
    return f"The noise: a column sigma in the states file, the detector's gain, or repeats of the states. {needed}"


@dataclass(frozen=True)
class Names:
    """Causes that the answer reports.

    Attributes
    ----------
    named : likely ones; doubt : why some of them have no sure name.
    untold : causes with as many values as the data have; they get no name.
    """

    named: tuple[Cause, ...]
    doubt: Mapping[Cause, str]
    untold: tuple[Cause, ...] = ()

    @property
    def sure(self) -> list[Cause]:
        """Causes without a doubt."""
        return [c for c in self.named if c.answer != "unknown" and c not in self.doubt]

    @property
    def rivals(self) -> list[tuple[Candidate, ...]]:
        """Sets of effects of which one is present."""
        return [(c.candidates[0], *c.other_effects) for c in self.named if c.other_effects]


def with_parts(
    posterior: Posterior, causes: Sequence[Cause], doubt: Mapping[Cause, str], *, chi2: float, noise_known: bool
) -> dict[Cause, str]:
    """Reasons of doubt by cause, with the causes that may be part of another mechanism.

    `chi2` is that of structure.
    """
    reasons = dict(doubt)
    for rank, cause in enumerate(causes, 1):
        if noise_known:
            weak = 2 * cause.log_odds * posterior.samples.best.unit < TIMES * rank**2 * chi2
        else:
            general = cause.candidates[0].effect.per_state or cause.candidates[0].is_pointwise
            directions = posterior.sets.noise.directions if general else 0.0
            weak = cause.log_odds < max(2 * NEEDED, TIMES * directions / 2)
        # What the simple form of another cause leaves over is no cause of its own.
        weak |= any(cause.log_odds < o.candidates[0].effect.rough * o.log_odds for o in causes)
        if cause not in reasons and weak:
            reasons[cause] = PART_OF_LEFT
    # A sentence is a part of an unknown mechanism, whose other parts look like effects of the list.
    if any(posterior.label(k).price for k in posterior.free_groups):
        reasons |= {cause: PART_OF_UNLISTED for cause in causes if cause not in reasons and cause.answer != "unlisted"}
    return reasons


def answer_of(cause: Cause, doubt: str | None) -> tuple[Answer, float]:
    """The word for a cause and its probability: one that may be part of another mechanism is at most likely, one
    with another doubt is unknown."""
    if doubt is None:
        return cause.answer, cause.probability
    probability = min(cause.probability, LIKELY)
    if doubt not in PARTS or cause.probability < SURE:
        return "unknown", probability
    return "one of" if cause.alternatives else "unlisted" if cause.candidates[0].price else "likely", probability
