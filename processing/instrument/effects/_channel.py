"""One number for each detector channel."""

from __future__ import annotations

from collections.abc import Sequence

from processing.instrument.changes import Conditions
from processing.instrument.effects.base import Effect
from processing.instrument.model import InstrumentModel, Polarizer


class ChannelEffect(Effect):
    """Acts in every channel by itself; needs at least two."""

    group = "mosaic"

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if len(model.channels) > 1 else ()


def polarizer_of(model: InstrumentModel, channel: int) -> str | None:
    """Name of the polarizer of a channel; None if it has none."""
    elements = model.channels[channel].elements
    return next((e.name for e in elements if isinstance(e, Polarizer)), None)
