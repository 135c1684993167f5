"""The polarizers of the channels leak.

Cause: wire grids have an extinction of 1:100 to 1:500 that falls towards the blue; oblique rays; pixel cross-talk.
Mend: measure each channel behind a turning polarizer and put the extinctions into the model.
"""

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects._channel import ChannelEffect, channel_polarizers, polarizer_of
from processing.instrument.model import InstrumentModel


class ChannelExtinction(ChannelEffect):
    """Extinction error (T_min over T_max) of each channel."""

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"channel_{c.name}", "1", -0.02, 0.5, 0.02) for c in model.channels)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        for k, value in enumerate(values):
            name = polarizer_of(model, k)
            if name is not None:
                changes.extinction[name] = changes.extinction[name] + value

    def shifts(self, model: InstrumentModel, place: str) -> tuple[str, ...]:
        return tuple(f"{name}.extinction" for name in channel_polarizers(model))
