"""What a correction of an instrument does to its captures, and to the Mueller matrices of these and later ones."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from processing.arrays import Array
from processing.diagnosis.instrument.answer import stretch
from processing.diagnosis.instrument.doubts import OF_THE_SAMPLE
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.decision import PredictedChange, chance_checks, held_out_check, rows_checks
from processing.diagnosis.search.fit import Fit, Solution
from processing.diagnosis.search.result import Check
from processing.diagnosis.search.rules import CHANCE_WORSE
from processing.diagnosis.search.space import Space


def checks(problem: InstrumentProblem, solved: Solution) -> tuple[Check, ...]:
    """Held-out residual, rank and condition of W, before and after: if one gets worse, it is no explanation."""
    out = [held_out_check(solved, stretch(problem, solved))]
    several = len(problem.captures) > 1
    for k, data in enumerate(problem.captures):
        if several:
            # The sum decides; what became of each is told also where nothing is written.
            old, new = (100 * found.of(k).rms for found in (solved.before, solved.after))
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
    return later.chance_worse <= CHANCE_WORSE and OF_THE_SAMPLE not in reasons


def _rows(problem: InstrumentProblem, k: int, space: Space, fit: Fit) -> Array:
    changes = problem.changes(k, space, fit.values)
    return problem.models[k].rows(problem.captures[k].conditions.angles_deg, changes).reshape(-1, 16)
