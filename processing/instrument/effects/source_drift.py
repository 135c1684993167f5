"""The source grows brighter or fainter during the capture, steadily or ever more slowly.

Cause: warming up (which slows down: the curvature), ageing, a thermal drift of the fibre coupling.
Mend: warm up for an hour, monitor the source with a second detector and divide, close the loop on its power.
"""

from collections.abc import Sequence

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OfOneCapture, SourceEffect
from processing.instrument.model import InstrumentModel


class SourceDrift(SourceEffect, OfOneCapture):
    """Relative change of the source from the first to the last state, and its departure from a straight line."""

    reference = "m00 is that for the source in the middle of the capture"
    fixed_parameters = (Parameter("fraction", "1", -0.9, 0.9, 0.02), Parameter("curvature", "1", -0.9, 0.9, 0.02))

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if conditions.states > 1 else ()

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        t = changes.conditions.elapsed
        # The curvature is how far the middle lies below the line between the ends.
        changes.gain = changes.gain * (1 + values[0] * t + values[1] * (4 * t**2 - 1))[:, None]
