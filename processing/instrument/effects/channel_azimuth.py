"""The azimuths of the channels' polarizers differ from the nominal ones.

Cause: lithography of the micropolarizers turned against the pixel grid, a Wollaston prism or a camera mounted askew.
Mend: turn a polarizer before the camera and fit each channel's azimuth.
"""

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects._channel import ChannelEffect, channel_polarizers, polarizer_of
from processing.instrument.model import InstrumentModel


class ChannelAzimuth(ChannelEffect):
    """Azimuth error of each channel's polarizer in degrees."""

    belongs_to = "mechanics"

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"channel_{c.name}", "degree", -20, 20, 1.0) for c in model.channels)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        for k, value in enumerate(values):
            name = polarizer_of(model, k)
            if name is not None:
                changes.azimuth_rad[name] = changes.azimuth_rad[name] + np.deg2rad(value)

    def shifts(self, model: InstrumentModel, place: str) -> tuple[str, ...]:
        return tuple(f"{name}.azimuth_deg" for name in channel_polarizers(model))
