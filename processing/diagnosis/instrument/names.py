"""Which causes are named, which are doubted, and what is not used for a correction because of that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from processing.diagnosis.instrument.doubts import (
    AS_WELL,
    BESIDE_PATTERN,
    ELSE,
    acts_on_unknown,
    doubts,
    something_else,
    testable,
)
from processing.diagnosis.instrument.outcome import Outcome
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause, causes
from processing.diagnosis.search.rules import DECISIVE, LIKELY
from processing.diagnosis.search.solution import Solution
from processing.instrument.effects.base import FieldEffect, ValuePerState


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


def unfit(problem: InstrumentProblem, solved: Solution, names: Names) -> list[Candidate]:
    """What is not used where an unknown sample takes up a part of it, for it may be any structure or a part of such."""
    # Values that are not random, or as many as the data have; and those of a source that were found beside them.
    reasons = (*ELSE, *AS_WELL, BESIDE_PATTERN)
    found = _candidates([*names.untold, *(cause for cause, reason in names.doubt.items() if reason in reasons)])
    if names.untold or something_else(names.doubt, DECISIVE):
        # Something is there that is not in the list: only what has a name of its own is no part of it.
        own = set(_candidates([cause for cause in names.named if cause not in names.doubt]))
        found += [
            c for c in solved.effects if c not in own and not (isinstance(c.effect, FieldEffect) or c.state_chosen)
        ]
    return [c for c in dict.fromkeys(found) if acts_on_unknown(problem, c)]


def _candidates(of: Sequence[Cause]) -> list[Candidate]:
    return [c for cause in of for c in (*cause.candidates, *cause.alternatives)]
