"""The channels of a mosaic or a beam splitter have unequal gains.

Cause: transmission of the micropolarizers differs between the four azimuths, read-out taps, two cameras.
Mend: divide by a flat of unpolarized light (integrating sphere), channel by channel.
"""

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects._channel import ChannelEffect
from processing.instrument.model import InstrumentModel


class ChannelGain(ChannelEffect):
    """Gain error of each channel but the first, relative to the first; a common factor is throughput."""

    of_channels = True

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"channel_{c.name}", "1", -0.5, 0.5, 0.02) for c in model.channels[1:])

    def shifts(self, model: InstrumentModel, place: str) -> tuple[str, ...]:
        return tuple(f"{c.name}.gain" for c in model.channels[1:])

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.gain = changes.gain * np.concatenate([[1.0], 1 + values])[None, :]
