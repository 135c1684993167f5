"""Pixels are clipped at the top of the range in some states.

Cause: too long an exposure for the brightest state, a glint.
Mend: shorten the exposure or bracket it. Clipped counts cannot be recovered: the correction excludes those pixels.
"""

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes
from processing.instrument.effects.base import OfOneCapture
from processing.instrument.model import InstrumentModel


class Saturation(OfOneCapture):
    """1: pixels with a clipped state are left out; the level is found from the counts, not fitted."""

    is_switch = True
    fixed_parameters = (Parameter("left_out", "1", 0, 1, 1.0),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.drop_clipped = changes.drop_clipped or bool(values[0] > 0.5)
