"""The light that reaches the generator's retarder is elliptical instead of linear.

Cause: stress in a window or prism behind the polarizer, a polarizer before a birefringent fibre or liquid light guide.
Mend: put the polarizer last before the retarder; look for stress between crossed polarizers; loosen the mount.
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OpticsEffect
from processing.instrument.model import InstrumentModel, Polarizer
from processing.polarization import mueller


class GeneratorEllipticity(OpticsEffect):
    """Ellipticity angle in degrees behind the generator's polarizer."""

    belongs_to = "dispersion"
    fixed_parameters = (Parameter("ellipticity", "degree", -20, 20, 1.0),)

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return tuple(e.name for e in model.generator if isinstance(e, Polarizer)) if len(model.generator) > 1 else ()

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        polarizer = next(e for e in model.generator if e.name == place)
        azimuth = np.deg2rad(float(polarizer.azimuth_deg)) if not isinstance(polarizer.azimuth_deg, dict) else 0.0
        changes.follow(place, mueller.retarder(azimuth + np.pi / 4, 2 * np.deg2rad(values[0])))
