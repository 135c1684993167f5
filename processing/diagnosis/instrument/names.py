"""Which causes are named, which are doubted, and what is not used for a correction because of that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from processing.diagnosis.instrument.doubts import (
    doubts,
    testable,
)
from processing.diagnosis.instrument.outcome import Outcome
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause, causes
from processing.diagnosis.search.rules import LIKELY
from processing.instrument.effects.base import ValuePerState


@dataclass(frozen=True)
class Names:
    """Causes that are told.

    Attributes
    ----------
    named : likely ones; doubt : why some of them have no sure name.
    untold : as many values as the data have, which have no name at all.
    """

    named: tuple[Cause, ...]
    untold: tuple[Cause, ...]
    doubt: Mapping[Cause, str]

    @property
    def sure(self) -> list[Cause]:
        """Those that nothing speaks against."""
        return [c for c in self.named if c.answer != "unknown" and c not in self.doubt]

    @property
    def rivals(self) -> list[tuple[Candidate, ...]]:
        """Sets of effects of which one is there."""
        return [(c.candidates[0], *c.others) for c in self.named if c.others]


def names_of(outcome: Outcome) -> Names:
    """Names of the causes of a posterior, as far as what is left over allows them."""
    asked, found, solved = outcome.asked, outcome.found, outcome.solved
    likely = tuple(c for c in causes(found, outcome.left) if c.probability >= LIKELY)
    untold = tuple(
        c
        for c in likely
        if isinstance(c.candidates[0].effect, ValuePerState) and not testable(asked, solved, c, likely)
    )
    named = tuple(c for c in likely if c not in untold)
    # What as many values as the data have took away may be any structure.
    left = outcome.left + sum(2 * c.log_odds * found.samples.best.unit for c in untold)
    return Names(named, untold, doubts(asked, found, solved, named, left))
