"""The mains modulate the lamp.

Cause: a lamp without a stabilized supply, exposures that are no multiple of a mains period.
Mend: expose for whole periods, or stabilize the supply.
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OfOneCapture, SourceEffect
from processing.instrument.model import InstrumentModel


class Hum(SourceEffect, OfOneCapture):
    """Amplitude of a modulation that repeats every eight states."""

    fixed_parameters = (Parameter("amplitude", "1", -0.5, 0.5, 0.01),)

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if conditions.states > 8 else ()

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        wave = np.sin(np.pi / 4 * np.arange(changes.conditions.states))
        changes.gain = changes.gain * (1 + values[0] * wave)[:, None]
