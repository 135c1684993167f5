"""The level of the source differs from state to state.

Cause: mode hopping or pump noise of the source, arc wander, an exposure short against the lamp's ripple, a shutter
that does not repeat.
Mend: monitor the source, average longer, lock the exposure to the mains; two channels of one beam splitter cancel it.
"""

from collections.abc import Sequence

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import SourceEffect, ValuePerState
from processing.instrument.model import InstrumentModel


class SourceFlicker(SourceEffect, ValuePerState):
    """Relative error of the gain of each state, common to all channels and pixels."""

    reference = "m00 is that for the source without what each state differs by"

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if conditions.states > 1 else ()

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"state_{k}", "1", -0.5, 0.5, 0.02) for k in range(conditions.states))

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.gain = changes.gain * (1 + values)[:, None]
