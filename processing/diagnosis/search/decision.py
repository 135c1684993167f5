"""The decision: which verdict an answer gets, and whether its correction is applied.

No correction is written that makes a measurement worse: figures before and after it are compared.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from processing.arrays import Array
from processing.diagnosis.search.fit import Solution
from processing.diagnosis.search.result import Check, Error, Verdict
from processing.diagnosis.search.rules import CHANCE_WORSE, LEAST_CHANGE, LIMIT, WORSE


def held_out_check(before: Error, after: Error) -> Check:
    """The residual on held-out data, percent."""
    return Check(
        name="rms on held-out data, percent of the mean signal",
        before=before.rms_percent,
        after=after.rms_percent,
        holds=bool(after.rms_percent <= WORSE * before.rms_percent),
    )


@dataclass(frozen=True, eq=False)
class PredictedChange:
    """Change of the result (M/m00, xi0) by a correction, as the posterior expects it; all rms over pixels.

    Attributes
    ----------
    before, after : error without and with the correction.
    size : of the change; expected, stderr : how far the true one goes along it, and the standard error of that, also
        (S,) of several sets of causes, each with its share.
    """

    before: float
    after: float
    size: float
    expected: float | Array
    stderr: float | Array
    share: float | Array = 1.0

    @property
    def is_change(self) -> bool:
        """Whether the result changes by more than the rounding of counts."""
        return self.size > LEAST_CHANGE

    @property
    def chance_worse(self) -> float:
        """Chance that the error grows: that the true change goes less than half as far along this one."""
        if not self.is_change:
            return 0.0
        missing = (self.size / 2 - self.expected) / np.maximum(self.stderr, 1e-9 * self.size)
        return float(np.sum(self.share * ndtr(missing)))

    @property
    def rounded_chance(self) -> float:
        """The same with no more digits than a calibration can show."""
        return round(self.chance_worse, 4)


#: Share (S,), mean (S,) and standard deviation (S,) in each set of causes of a sum of values with weights (K,).
Along = Callable[[Array], tuple[Array, Array, Array]]


def predicted_change(
    correction: Array, mean: Array, covariance: Array, products: Array, *, along: Along | None = None
) -> PredictedChange:
    """Change by a `correction` (K,), where the true values have a mean (K,) and a covariance (K, K).

    `products` (K, K) of the slopes of what the user reads, averaged. Without `along` the values are normal.
    """
    missed, variance = mean - correction, max(float(np.sum(products * covariance)), 0.0)
    size = float(np.sqrt(max(float(correction @ products @ correction), 0.0)))
    before, after = (np.sqrt(variance + max(float(v @ products @ v), 0.0)) for v in (mean, missed))
    w = products @ correction / max(size, 1e-300)
    share, expected, stderr = along(w) if along else (1.0, mean @ w, np.sqrt(max(float(w @ covariance @ w), 0.0)))
    return PredictedChange(float(before), float(after), size, expected, stderr, share)


def chance_checks(quantity: str, change: PredictedChange) -> tuple[Check, Check]:
    """Error of a quantity as the posterior expects it, and the chance that it grows, which decides."""
    return (
        Check(name=f"predicted error of {quantity}, rms", before=change.before, after=change.after, holds=True),
        Check(
            name=f"chance that the error of {quantity} grows",
            before=0.0,
            after=change.rounded_chance,
            holds=change.chance_worse <= CHANCE_WORSE,
            is_chance=True,
        ),
    )


def refusal(figures: tuple[Check, ...]) -> str | None:
    """Why a correction is not written, in words; None if every figure holds."""
    worse = [c.text for c in figures if not c.holds]
    return "; ".join(worse) if worse else None


@dataclass(frozen=True)
class Judgement:
    """Evidence for an answer, and against it.

    Attributes
    ----------
    named, sure : whether a cause is present, and whether the name of one is without doubt.
    structure : whether tests find structure in the residual.
    observable : whether a fault of typical size would have been seen.
    figures : of the residual, before and after; chances : that what the user reads gets worse.
    first : what has to be changed before anything else means something.
    """

    named: bool
    sure: bool
    structure: bool
    observable: bool
    figures: tuple[Check, ...] = ()
    chances: tuple[Check, ...] = ()
    first: str | None = None

    @property
    def verdict(self) -> Verdict:
        """Verdict from names and structure; a correction that increases the residual explains nothing."""
        if self.first is not None or (self.named and refusal(self.figures) is not None):
            return "unexplained"
        if self.structure:
            return "partly_explained" if self.sure else "unexplained"
        if self.named:
            return "explained" if self.sure else "partly_explained"
        return "consistent" if self.observable else "undetermined"

    @property
    def checks(self) -> tuple[Check, ...]:
        """All figures that a correction is judged by."""
        return (*self.figures, *self.chances)

    @property
    def refused(self) -> str | None:
        """Why the correction is not written, in words; None if every figure holds."""
        return refusal(self.checks) if self.first is None else f"change this first: {self.first}"

    def applied(self, solved: Solution, any_cause: bool) -> Solution:
        """The applied correction: a solution that holds and is not empty; else none."""
        holds = self.refused is None and (any_cause or any(c.place for c in solved.base.candidates))
        return solved if holds else solved.undone


def beyond_chance(tests: Mapping[str, float]) -> dict[str, float]:
    """The tests of a capture that are beyond chance; the largest first."""
    return dict(sorted(((name, value) for name, value in tests.items() if value > LIMIT), key=lambda item: -item[1]))


def in_words(tests: Mapping[str, float]) -> list[str]:
    """Sentences about the tests that are beyond chance."""
    return [f"{name}: {value:.0f} standard deviations above noise" for name, value in beyond_chance(tests).items()]


def in_deviations(tests: Mapping[str, tuple[float, float, float]]) -> tuple[dict[str, float], float]:
    """Tests in standard deviations, and the most chi-square that is beyond two of them.

    Of each the chi-square beyond noise, its deviation, and what noise gives; infinity if it is no sum of squares.
    """
    excess = max(chi2 - 2 * deviation for chi2, deviation, _ in tests.values())
    return {name: _normal_deviate(*test) for name, test in tests.items()}, max(float(excess), 0.0)


def _normal_deviate(beyond: float, deviation: float, noise: float) -> float:
    """Standard deviations by which a normal variate is as unlikely (Wilson and Hilferty, PNAS 17, 684, 1931).

    Of few directions a sum of squares is five deviations off a thousand times as often as a normal variate.
    """
    if not 0 < noise < np.inf:
        return float(beyond / deviation)
    width = deviation / (3 * noise)
    return float((np.cbrt(1 + beyond / noise) - 1) / width + width)
