"""The image moves in a circle (or an ellipse) as an element turns.

Cause: a wedged or tilted plate on a turning axis deviates the beam once per turn.
Mend: use a plate with under an arc minute of wedge, set it normal to the axis; register the frames.
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import ImageShift, moving_axes
from processing.instrument.model import InstrumentModel


class BeamWander(ImageShift):
    """Amplitudes in pixels of cos and sin of the turned angle, x to the right and y down."""

    belongs_to = "mechanics"
    fixed_parameters = tuple(Parameter(n, "pixel", -5, 5, 0.2) for n in ("x_cos", "x_sin", "y_cos", "y_sin"))

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        axes = moving_axes(model, conditions)
        return tuple(e.name for e in model.elements() if e.axis in axes)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        element = next(e for e in model.elements() if e.name == place)
        t = np.deg2rad(element.ratio * changes.conditions.angles_deg[element.axis or ""])
        x, y = values[0] * np.cos(t) + values[1] * np.sin(t), values[2] * np.cos(t) + values[3] * np.sin(t)
        changes.shift_px = changes.shift_px + np.stack([x, y], axis=1)
