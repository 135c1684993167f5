"""One number for each detector channel."""

from collections.abc import Sequence

from processing.instrument.changes import Conditions
from processing.instrument.effects.base import OpticsEffect
from processing.instrument.model import InstrumentModel, Polarizer


class ChannelEffect(OpticsEffect):
    """Acts in every channel by itself; needs at least two."""

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if len(model.channels) > 1 else ()


def polarizer_of(model: InstrumentModel, channel: int) -> str | None:
    """Name of the polarizer of a channel; None if it has none."""
    elements = model.channels[channel].elements
    return next((e.name for e in elements if isinstance(e, Polarizer)), None)


def channel_polarizers(model: InstrumentModel) -> tuple[str, ...]:
    """Names of the polarizers of all channels."""
    names = (polarizer_of(model, k) for k in range(len(model.channels)))
    return tuple(name for name in names if name is not None)
