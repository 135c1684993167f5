"""The polarizers of the channels leak.

Cause: wire grids have an extinction of 1:100 to 1:500 that falls towards the blue; oblique rays; pixel cross-talk.
Mend: measure each channel behind a turning polarizer and put the extinctions into the model.
"""

from processing.effect import Parameter
from processing.instrument.changes import Conditions
from processing.instrument.effects._channel import ChannelPolarizers
from processing.instrument.model import InstrumentModel


class ChannelExtinction(ChannelPolarizers):
    """Extinction error (T_min over T_max) of each channel."""

    field = "extinction"

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"channel_{c.name}", "1", -0.02, 0.5, 0.02) for c in model.channels)
