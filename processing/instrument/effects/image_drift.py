"""The image moves steadily over the detector during the capture.

Cause: the mount of camera or sample warms up or sags.
Mend: let the bench settle, stiffen it, register the frames on a fixed mark.
"""

from collections.abc import Sequence

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import ImageShift, OfOneCapture
from processing.instrument.model import InstrumentModel


class ImageDrift(ImageShift, OfOneCapture):
    """Pixels from the first to the last state, x to the right and y down."""

    belongs_to = "capture"
    reference = "the image stands where it was in the first state"
    fixed_parameters = tuple(Parameter(n, "pixel", -5, 5, 0.2) for n in ("x", "y"))

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if conditions.states > 1 else ()

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.shift_px = changes.shift_px + (changes.conditions.elapsed[:, None] + 0.5) * values
