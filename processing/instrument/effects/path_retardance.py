"""A linear retardance between generator and analyzer is missing in the model, or in the stated sample.

Cause: a window, beam splitter or lens under stress; a mirror at an angle; strain in the cell. An unknown sample
absorbs it: only air, a mirror or another known sample shows it.
Mend: look between crossed polarizers for the strained part; put the element's Mueller matrix into the train.
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OpticsEffect
from processing.instrument.model import InstrumentModel
from processing.polarization import mueller


class PathRetardance(OpticsEffect):
    """Two components of a linear retardance in degrees: fast axis at 0, and at 45 degrees."""

    belongs_to = "dispersion"
    fixed_parameters = tuple(Parameter(n, "degree", -40, 40, 1.0) for n in ("at_0", "at_45"))

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return ("",) if len(model.generator) > 1 else ()

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        size, azimuth = np.hypot(*values), np.arctan2(values[1], values[0]) / 2
        changes.follow(model.generator[-1].name, mueller.retarder(azimuth, np.deg2rad(size)))
