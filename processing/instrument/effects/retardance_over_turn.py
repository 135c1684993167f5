"""A retarder's retardance changes as it turns, up and down once per turn.

Cause: the beam meets a wedged plate, or one with halves cemented under a wedge, off the axis of rotation. Or
plate and beam are both tilted to the axis.
Mend: centre the plate on the beam and set both along the axis; use a true zero-order plate, which tilt changes least.
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OpticsEffect, moving_axes, turns
from processing.instrument.model import InstrumentModel, Retarder


class RetardanceOverTurn(OpticsEffect):
    """Degrees of retardance: cos and sin of the turned angle.

    Twice per turn, which a beam tilted to the axis makes, is not looked for: with an unknown sample a diattenuation
    beside it does nearly what a transmission twice per turn does.
    """

    belongs_to = "dispersion"
    # Half a minute of wedge, met 1 mm beside the axis, is 1.3 nm in quartz: a degree in the visible.
    fixed_parameters = tuple(Parameter(n, "degree", -10, 10, 0.5) for n in ("cos", "sin"))

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        axes = moving_axes(model, conditions)
        plates = (e for e in model.elements() if isinstance(e, Retarder) and e.axis in axes)
        # Over less than half a turn this wave is hardly anything else than another retardance with a slope.
        return tuple(e.name for e in plates if np.ptp(e.ratio * conditions.angles_deg[e.axis or ""]) > 180)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        cos, sin, *_ = turns(model, changes.conditions, place)
        change = values[0] * cos + values[1] * sin
        changes.retardance_rad[place] = changes.retardance_rad[place] + np.deg2rad(change)
