"""The signal changes with the azimuth of a turning analyzer, once and twice per turn.

Cause: once: dirt or wedge of the polarizer. Twice: optics behind the analyzer (beam splitter, grating, detector) are
sensitive to polarization, or the light that comes to it is polarized.
Mend: put a depolarizer or a fixed polarizer behind the turning one; or turn the retarder instead of the polarizer.
"""

from processing.instrument.effects._transmission import Transmission
from processing.instrument.model import Polarizer


class AnalyzerTransmission(Transmission):
    """Transmission behind a turning polarizer."""

    element = Polarizer
