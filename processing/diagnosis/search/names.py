"""Names of causes, and doubts about them because of the residual."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Answer, Cause
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import LIKELY, NEEDED, SURE, TIMES

#: Reasons that leave a name likely.
PART_OF_LEFT = "it may be a part of what is left unexplained"
PART_OF_UNLISTED = "it may be a part of the fault that has no name"
PARTS = (PART_OF_LEFT, PART_OF_UNLISTED)


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
