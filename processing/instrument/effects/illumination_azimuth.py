"""The polarization of the illumination is turned as a whole.

Found against a known reflectance (`processing.reflectance.effects.illumination_azimuth`), it acts here.
Cause: polarizer of the source not horizontal, arm or source rolled about the beam.
Mend: level the source's polarizer against the camera's with the arm at 180 degrees.
"""

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes
from processing.instrument.effects.base import InstrumentEffect
from processing.instrument.model import InstrumentModel
from processing.polarization import mueller


class IlluminationAzimuth(InstrumentEffect):
    """Degrees by which the polarization behind the generator is turned."""

    belongs_to = "mechanics"
    from_file_only = True
    fixed_parameters = (Parameter("azimuth", "degree", -20, 20, 1.0),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        changes.follow(model.generator[-1].name, mueller.rotation(np.deg2rad(values[0])))
