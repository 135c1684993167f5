"""The stored counts are a power of the light: counts / full scale = (light / full scale)^(1 / gamma).

Cause: a camera or file format with gamma correction (8-bit pictures usually have one), a "contrast" setting.
Mend: turn gamma off, store raw counts; otherwise invert the curve first.
"""

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import STRAIGHT_BELOW, Changes, Conditions
from processing.instrument.effects.base import PointwiseEffect
from processing.instrument.model import InstrumentModel


class ToneCurve(PointwiseEffect):
    """gamma - 1; light = full scale * (counts / full scale)^gamma."""

    is_response = True
    fixed_parameters = (Parameter("gamma_minus_1", "1", -0.5, 1.5, 0.03),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        e = values[0]
        # y^(1 + e) = y (1 + e ln y + e^2/2 ln^2 y + ...), y = counts over full scale.
        for name, factor in (("log", e), ("log_square", e * e / 2), ("log_cube", e**3 / 6)):
            changes.response[name] = changes.response[name] + factor

    def undo(self, signal: Array, conditions: Conditions, place: str, values: Array) -> tuple[Array, Array]:
        power = np.maximum(signal, STRAIGHT_BELOW) ** values[0]
        return signal * power, (1 + values[0] * (signal > STRAIGHT_BELOW)) * power
