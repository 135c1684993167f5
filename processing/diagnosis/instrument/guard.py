"""What a correction of an instrument does to its captures, and to the Mueller matrices of these and later ones."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.instrument.doubts import CHANGED
from processing.diagnosis.instrument.mueller_slopes import mueller_slopes
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.systematic import ELEMENTS
from processing.diagnosis.instrument.telling import stretch
from processing.diagnosis.search.fit import Fit
from processing.diagnosis.search.guard import (
    NOTHING,
    PredictedChange,
    chance_checks,
    held_out_check,
    predicted_change,
    rows_checks,
)
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.result import Check
from processing.diagnosis.search.rules import CHANCE_WORSE
from processing.diagnosis.search.solution import Solution
from processing.diagnosis.search.space import Space
from processing.diagnosis.search.stored import scope_of
from processing.instrument.effects.base import FieldEffect, Switch


def checks(problem: InstrumentProblem, solved: Solution) -> tuple[Check, ...]:
    """Held-out residual, rank and condition of W, before and after: if one gets worse, it is no explanation."""
    out = [held_out_check(solved, stretch(problem, solved))]
    several = len(problem.captures) > 1
    for k, data in enumerate(problem.captures):
        if several:
            # The sum decides; what became of each is told also where nothing is written.
            old, new = (100 * found.rms_of(k) for found in (solved.before, solved.after))
            name = f"rms on held-out data of {data.name} at {data.wavelength_nm:g} nm, percent"
            out.append(Check(name=name, before=old, after=new, holds=True))
        out += rows_checks(
            data.name,
            *(
                _rows(problem, k, space, fit)
                for space, fit in ((solved.base, solved.before_fit), (solved.space, solved.fit))
            ),
        )
    return tuple(out)


def predicted_changes(problem: InstrumentProblem, found: Posterior, solved: Solution) -> tuple[PredictedChange, ...]:
    """What a correction does to the captures it was found on, and what its part does that later ones have too."""
    slopes = slopes_of(problem, found, solved)
    if slopes is None:
        return NOTHING, NOTHING
    everything = np.ones(slopes.index.size, dtype=bool)
    return tuple(slopes.predicted_change(found, slopes.given, part) for part in (everything, slopes.lasting))


@dataclass(frozen=True)
class Slopes:
    """How the values that may not be zero move M/m00.

    Attributes
    ----------
    index : (K,) their places in the posterior.
    given : (K,) as the correction has them, zero where it has none; applied : (K,) whether it has one.
    lasting : (K,) those of effects that later captures have too.
    products : (K, K) of the slopes of M/m00, mean over pixels and elements.
    """

    index: NDArray[np.int64]
    given: Array
    applied: NDArray[np.bool_]
    lasting: NDArray[np.bool_]
    products: Array

    def predicted_change(self, found: Posterior, given: Array, part: NDArray[np.bool_]) -> PredictedChange:
        """What values `given` (K,) do, of which only a `part` (K,) is there."""
        index, own = self.index[part], np.ix_(part, part)
        covariance = found.covariance[np.ix_(index, index)]
        return predicted_change_of_part(
            given[part], found.values[index], covariance, self.products[own], self.applied[part]
        )


def predicted_change_of_each(
    problem: InstrumentProblem, found: Posterior, solved: Solution
) -> dict[str, PredictedChange]:
    """What a correction does to each of several captures, by name; nothing is said of one by itself."""
    out: dict[str, PredictedChange] = {}
    for k, data in enumerate(problem.captures if len(problem.captures) > 1 else ()):
        slopes = slopes_of(problem, found, solved, k)
        if slopes is not None:
            everything = np.ones(slopes.index.size, dtype=bool)
            out[data.name] = slopes.predicted_change(found, slopes.given, everything)
    return out


def slopes_of(problem: InstrumentProblem, found: Posterior, solved: Solution, only: int | None = None) -> Slopes | None:
    """Slopes of the values of a correction and of what may be there in their place; None where M follows none.

    Of the pixels of all captures, or of `only` one.
    """
    correction = {c for c in solved.effects if not isinstance(c.effect, FieldEffect | Switch)}
    if not correction:
        return None
    spread = np.diag(found.covariance)
    part = {
        c: np.r_[p]
        for c, p in zip(found.space.candidates, found.space.slices, strict=True)
        if c in correction or (not isinstance(c.effect, FieldEffect | Switch) and spread[p].any())
    }
    space, index = Space(tuple(part)), np.concatenate([*part.values()])
    products, light = mueller_slopes(problem, space, found.values[index], _left(problem, solved), only)
    given = dict(zip(solved.space.candidates, solved.space.slices, strict=True))
    return Slopes(
        index,
        np.concatenate([solved.fit.values[given[c]] if c in correction else np.zeros(c.size) for c in part]),
        np.concatenate([np.full(c.size, c in correction) for c in part]),
        np.concatenate([np.full(c.size, scope_of(c) == "instrument") for c in part]),
        products.sum(axis=0) / (max(light, 1e-300) * ELEMENTS),
    )


def _left(problem: InstrumentProblem, solved: Solution) -> Array:
    """What is left over of each capture (captures,) after the correction, in units of its noise; noise at least."""
    noise = np.array([m.noise_floor for m in problem.moments])
    left = np.array([solved.after.rms_of(k) for k in range(noise.size)])
    return np.asarray(np.maximum(left / np.maximum(noise, 1e-300), 1.0))


def predicted_change_of_part(
    given: Array, mean: Array, covariance: Array, products: Array, applied: NDArray[np.bool_]
) -> PredictedChange:
    """Where only those `applied` (K,) are corrected, by values `given` (K,), of a mean (K,) and a covariance (K, K).

    Where an applied value is wrong, an alternative may stand in for it that moves M in the same way, as the covariance
    tells; that counts in its favour. What else is uncertain is so whatever is applied.
    """
    own = covariance[np.ix_(applied, applied)]
    with_others = covariance[:, applied] @ np.linalg.pinv(own, hermitian=True)
    alone = np.where(np.outer(applied, applied), covariance, 0.0)
    together = with_others @ own @ with_others.T
    true = np.where(applied, mean, 0.0)
    told = (predicted_change(given, true, errors, products) for errors in (alone, together))
    return min(told, key=lambda one: one.chance_worse)


def chances(
    here: PredictedChange, later: PredictedChange, lasting: bool, each: Mapping[str, PredictedChange]
) -> tuple[Check, ...]:
    """Error of M as the posterior expects it, and the chance that it grows: an explanation may be too vague to use.

    Of all captures together it decides. Of `each` of several it is told: a sample that hardly polarizes gains little
    and may lose. What is too vague for later captures is written for these alone (`lasts`).
    """
    predicted, grows = chance_checks("M/m00", here)
    alone = "" if lasting else ", so it is written for these captures alone"
    return (
        predicted,
        grows,
        Check(name=f"{grows.name} in later captures{alone}", before=0.0, after=later.rounded_chance, holds=True),
        *(
            Check(
                name=f"predicted error of M/m00 of {name}, rms (it grows with a chance of {_in_words(change)})",
                before=change.before,
                after=change.after,
                holds=True,
            )
            for name, change in each.items()
        ),
    )


def _in_words(change: PredictedChange) -> str:
    return f"{change.rounded_chance:.2g}" if change.rounded_chance > 0 else "less than 0.0001"


def lasts(later: PredictedChange, reasons: Collection[str] = ()) -> bool:
    """Whether what belongs to the instrument may be used for later captures; `reasons` for which names are doubted.

    Where the sample changed, what is found of the instrument may be a part of that.
    """
    return later.chance_worse <= CHANCE_WORSE and not any(reason in CHANGED for reason in reasons)


def _rows(problem: InstrumentProblem, k: int, space: Space, fit: Fit) -> Array:
    changes = problem.changes(k, space, fit.values)
    return problem.models[k].rows(problem.captures[k].conditions.angles_deg, changes).reshape(-1, 16)
