"""The signal changes with the azimuth of a turning analyzer, once and twice per turn.

Cause: once: dirt or wedge of the polarizer. Twice: optics behind the analyzer (beam splitter, grating, detector) are
sensitive to polarization, or the light that comes to it is polarized.
Mend: put a depolarizer or a fixed polarizer behind the turning one; or turn the retarder instead of the polarizer.
"""

from collections.abc import Sequence

from processing.instrument.changes import Conditions
from processing.instrument.effects._transmission import Transmission
from processing.instrument.effects.base import moving_axes
from processing.instrument.model import InstrumentModel, Polarizer


class AnalyzerTransmission(Transmission):
    """Transmission behind a turning polarizer."""

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        axes = moving_axes(model, conditions)
        return tuple(e.name for e in model.elements() if isinstance(e, Polarizer) and e.axis in axes)
