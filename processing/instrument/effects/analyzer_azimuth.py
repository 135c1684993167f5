"""The azimuth of the analyzer's polarizer differs from the model.

Cause: the polarizer was turned in its cell, or the camera and analyzer were remounted together.
An unknown sample does not separate it from an azimuth error of the analyzer's retarder.
Mend: calibrate on air; look through crossed polarizers and note the dark position.
"""

from collections.abc import Sequence

from processing.effect import Parameter
from processing.instrument.changes import Conditions
from processing.instrument.effects.base import NominalShift
from processing.instrument.model import InstrumentModel, Polarizer


def polarizers(model: InstrumentModel) -> tuple[str, ...]:
    """Polarizers of the analyzer and of its channels."""
    elements = (*model.analyzer, *(e for c in model.channels for e in c.elements))
    return tuple(e.name for e in elements if isinstance(e, Polarizer))


class AnalyzerAzimuth(NominalShift):
    """All polarizers behind the sample are turned together, in degrees."""

    belongs_to = "mechanics"
    field = "azimuth_deg"
    fixed_parameters = (Parameter("azimuth", "degree", -90, 90, 1.0),)

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if polarizers(model) and model.mosaic is None else ()

    def elements(self, model: InstrumentModel, place: str) -> Sequence[str]:
        return polarizers(model)
