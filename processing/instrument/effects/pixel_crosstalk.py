"""A fraction of each pixel's light is collected by its four neighbours, which look through other polarizers.

Cause: charge diffusion and light that crosses between the micropolarizer and the photodiode, worse in the red.
In uniform light it lowers the contrast of all channels alike, as a leak of the polarizers does.
Mend: a longer focal length or smaller aperture; unmix with the neighbours' weights from a turning polarizer.
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OpticsEffect
from processing.instrument.model import InstrumentModel


def neighbours(mosaic: tuple[tuple[str, ...], ...], channels: Sequence[str]) -> Array:
    """(channels, channels): fraction of each channel's four neighbours that belongs to each channel."""
    rows, columns = len(mosaic), len(mosaic[0])
    names = list(channels)
    shares = np.zeros((len(names), len(names)))
    for r in range(rows):
        for c in range(columns):
            for dr, dc in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                neighbour = mosaic[(r + dr) % rows][(c + dc) % columns]
                shares[names.index(mosaic[r][c]), names.index(neighbour)] += 0.25
    return shares


class PixelCrosstalk(OpticsEffect):
    """Fraction of a pixel's light that its neighbours collect."""

    fixed_parameters = (Parameter("fraction", "1", -0.05, 0.5, 0.02),)

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if model.mosaic is not None else ()

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        n = len(model.channels)
        spread = neighbours(model.mosaic or (), [c.name for c in model.channels])
        mix = (1 - values[0]) * np.eye(n) + values[0] * spread
        changes.mixing = mix if changes.mixing is None else mix @ changes.mixing
