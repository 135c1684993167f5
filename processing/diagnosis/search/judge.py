"""The judge: which verdict an answer gets, and whether its correction is applied."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from processing.diagnosis.search.guard import refusal
from processing.diagnosis.search.result import Check, Verdict
from processing.diagnosis.search.rules import LIMIT, LIMIT_OF_TWO
from processing.diagnosis.search.solution import Solution


@dataclass(frozen=True)
class Judgement:
    """What speaks for an answer, and against it.

    Attributes
    ----------
    named, sure : whether any cause has a name, and whether nothing speaks against one of them.
    structure : whether tests see something in what is left.
    seen : whether a fault of typical size would have been seen.
    figures : of the residual and of W, before and after; chances : that what the user reads gets worse.
    first : what has to be changed before anything else means something.
    """

    named: bool
    sure: bool
    structure: bool
    seen: bool
    figures: tuple[Check, ...] = ()
    chances: tuple[Check, ...] = ()
    first: str | None = None

    @property
    def verdict(self) -> Verdict:
        """Of names and structure; a correction by which the residual or W gets worse explains nothing."""
        if self.first is not None or (self.named and refusal(self.figures) is not None):
            return "unexplained"
        if self.structure:
            return "partly_explained" if self.sure else "unexplained"
        if self.named:
            return "explained" if self.sure else "partly_explained"
        return "consistent" if self.seen else "undetermined"

    @property
    def checks(self) -> tuple[Check, ...]:
        """All figures that a correction is judged by."""
        return (*self.figures, *self.chances)

    @property
    def refused(self) -> str | None:
        """Why the correction is not written, in words; None if every figure holds."""
        return refusal(self.checks) if self.first is None else f"change this first: {self.first}"

    def kept(self, solved: Solution, any_cause: bool) -> Solution:
        """What is applied: a solution that holds, if there is anything in it; else nothing."""
        holds = self.refused is None and (any_cause or any(c.place for c in solved.base.candidates))
        return solved if holds else solved.undone


def beyond_chance(tests: Mapping[str, float]) -> dict[str, float]:
    """The tests of a capture that are beyond chance, one by itself or two together; the largest first."""
    in_order = sorted(tests.items(), key=lambda item: -item[1])
    two = dict(item for item in in_order if item[1] > LIMIT_OF_TWO)
    return two if len(two) > 1 else dict(item for item in in_order if item[1] > LIMIT)
