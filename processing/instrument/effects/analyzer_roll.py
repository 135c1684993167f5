"""The whole analyzer, with the camera or without it, is turned about the beam.

Found with a known reflectance (`processing.reflectance.effects.analyzer_roll`), it acts here.
Cause: the camera body or the analyzer unit is mounted at an angle.
Mend: level it against the source's polarizer with the arm at 180 degrees.
"""

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes
from processing.instrument.effects.base import InstrumentEffect
from processing.instrument.model import InstrumentModel


class AnalyzerRoll(InstrumentEffect):
    """Degrees by which every element of the analyzer is turned."""

    belongs_to = "mechanics"
    from_file_only = True
    fixed_parameters = (Parameter("azimuth", "degree", -20, 20, 1.0),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        for element in (*model.analyzer, *(e for c in model.channels for e in c.elements)):
            changes.azimuth_rad[element.name] = changes.azimuth_rad[element.name] + np.deg2rad(values[0])
