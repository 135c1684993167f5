"""A retarder's retardance changes during the capture; at the first state it is that of the model.

Cause: the plate warms up (motor, lamp, room), a liquid-crystal cell or a stressed mount settles.
Mend: let it settle before the first state, keep lamp and motor away from the plate, use an athermal pair.
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OfOneCapture, OpticsEffect
from processing.instrument.model import InstrumentModel, Retarder


class RetardanceDrift(OpticsEffect, OfOneCapture):
    """Degrees from the first to the last state, and the bends of its course, which are zero at both."""

    reference = "the retardance of the file is that of the first state"
    fixed_parameters = tuple(Parameter(n, "degree", -20, 20, 1.0) for n in ("change", "bend_2", "bend_3"))

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return tuple(e.name for e in model.elements() if isinstance(e, Retarder)) if conditions.states > 4 else ()

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        t = changes.conditions.elapsed + 0.5
        course = values[0] * t + values[1] * 4 * t * (1 - t) + values[2] * 8 * t * (1 - t) * (1 - 2 * t)
        changes.retardance_rad[place] = changes.retardance_rad[place] + np.deg2rad(course)
