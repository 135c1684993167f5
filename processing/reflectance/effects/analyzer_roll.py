"""The whole analyzer, with the camera or without it, is turned about the beam.

Cause: the camera body or the analyzer unit is mounted at an angle; the polarization camera's mount is not level.
Mend: level it against the source's polarizer with the arm at 180 degrees. Or use a sphere near Omega 0: its pattern of
polarization is symmetric about the horizontal line.
"""

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect


class SurfaceAnalyzerRoll(ReflectanceEffect):
    """Degrees by which every element of the analyzer is turned.

    A known surface shows it; with an unknown sample it is a part of the Mueller matrix.
    """

    fixed_parameters = (Parameter("azimuth", "degree", -20, 20, 1.0),)

    def bend(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        changes.analyzer_rad += float(np.deg2rad(values[0]))
