"""The generator's polarizer leaks: its extinction (T_min over T_max) is larger than the model's.

Cause: a film polarizer outside its band, an uncoated or dirty prism, a beam wider than the acceptance angle.
With an unknown sample it cannot be seen at all (trap 8).
Mend: measure the polarizer between crossed partners at this wavelength; use a crystal polarizer.
"""

from __future__ import annotations

from collections.abc import Sequence

from processing.changes import Changes, Conditions
from processing.effects.base import Array, Effect, Parameter
from processing.instrument import InstrumentModel, Polarizer


class This(Effect):
    """Extinction error, a ratio of intensities."""

    group = "optics"

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return tuple(e.name for e in model.generator if isinstance(e, Polarizer))

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        # A little below zero is allowed, so that noise about a perfect polarizer is not pushed to one side.
        return (Parameter("extinction", "1", -0.02, 0.5, 0.01),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.extinction[place] = changes.extinction[place] + values[0]
