"""The azimuths of the channels' polarizers differ from the nominal ones.

Cause: lithography of the micropolarizers turned against the pixel grid, a Wollaston prism or a camera mounted askew.
Mend: turn a polarizer before the camera and fit each channel's azimuth.
"""

from processing.effect import Parameter
from processing.instrument.changes import Conditions
from processing.instrument.effects._channel import ChannelPolarizers
from processing.instrument.model import InstrumentModel


class ChannelAzimuth(ChannelPolarizers):
    """Azimuth error of each channel's polarizer in degrees."""

    belongs_to = "mechanics"
    field = "azimuth_deg"

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"channel_{c.name}", "degree", -20, 20, 1.0) for c in model.channels)
