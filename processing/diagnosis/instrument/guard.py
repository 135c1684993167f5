"""What a correction of an instrument does to the Mueller matrices of its captures and of later ones."""

from collections.abc import Collection, Mapping

from processing.diagnosis.instrument.doubts import OF_THE_SAMPLE
from processing.diagnosis.search.decision import PredictedChange, chance_checks
from processing.diagnosis.search.result import Check
from processing.diagnosis.search.rules import CHANCE_WORSE


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
