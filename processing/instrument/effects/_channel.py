"""One number for each detector channel."""

from collections.abc import Sequence
from typing import ClassVar

from processing.arrays import Array
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OpticsEffect
from processing.instrument.model import InstrumentModel, Polarizer
from processing.instrument.nominal import shift_nominal


class ChannelEffect(OpticsEffect):
    """Acts in every channel by itself; needs at least two."""

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if len(model.channels) > 1 else ()


class ChannelPolarizers(ChannelEffect):
    """Adds a value for each channel to one field of its polarizer, and does nothing else."""

    field: ClassVar[str]

    def shifts(self, model: InstrumentModel, place: str) -> tuple[str, ...]:
        return tuple(f"{name}.{self.field}" for name in channel_polarizers(model))

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        for k, value in enumerate(values):
            name = polarizer_of(model, k)
            if name is not None:
                shift_nominal(changes, model, f"{name}.{self.field}", value)


def polarizer_of(model: InstrumentModel, channel: int) -> str | None:
    """Name of the polarizer of a channel; None if it has none."""
    elements = model.channels[channel].elements
    return next((e.name for e in elements if isinstance(e, Polarizer)), None)


def channel_polarizers(model: InstrumentModel) -> tuple[str, ...]:
    """Names of the polarizers of all channels."""
    names = (polarizer_of(model, k) for k in range(len(model.channels)))
    return tuple(name for name in names if name is not None)
