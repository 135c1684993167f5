"""The level of the source differs between the runs that took states of one capture.

Cause: a capture was interrupted and resumed: the lamp was off in between, or continued to warm up.
Mend: let the source warm up again before you resume, or take the capture anew.
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OfOneCapture, SourceEffect
from processing.instrument.model import InstrumentModel


class SourceJump(SourceEffect, OfOneCapture):
    """Relative change of the source in each later run, against the first one that took states of the sample."""

    reference = "m00 is that for the source in the first run"

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if np.unique(conditions.run).size > 1 else ()

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"run_{k + 1}", "1", -0.9, 9.0, 0.05) for k in np.unique(conditions.run)[1:])

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        run = changes.conditions.run
        of_run = run[:, None] == np.unique(run)[1:]
        changes.gain = changes.gain * (1 + of_run @ values)[:, None]
