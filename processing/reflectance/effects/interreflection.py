"""Some of the light met two facets, or the object and its support, before it reached the camera.

Cause: rough or concave surfaces, a bright holder or table near the object.
Mend: black cloth around the object, a thin pin as support; exclude concave parts from the fit.
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect


class Interreflection(ReflectanceEffect):
    """Weight of light that met two facets over that which met one; place "support": light from below.

    The support's light arrives depolarized from a level disc below, and the surface polarizes it as it does the
    source's. The parameters: irradiance of the object's middle over the source's; by how much the half angle of the
    disc, seen from there, differs from 35 degrees; logarithm of its depth over twice the object's half width; how much
    brighter the disc is at its edge, along x and z; and how much more the surface sends back at grazing angles than
    its own pixels tell.
    """

    # A support is no disc, and where its light is cut off by the object itself is not known.
    rough = 0.2
    has_bent_valley = True

    def places_on(self, shape: str) -> Sequence[str]:
        return ("", "support")

    def parameters(self, place: str) -> tuple[Parameter, ...]:
        if place == "support":
            form = (Parameter("reach", "degree", -30, 40, 10), Parameter("log_depth", "1", -0.6, 3.0, 0.3))
            # Typical sizes that keep what the data cannot see near zero.
            more = (Parameter(name, "1", -2, 2, 0.05) for name in ("slope_x", "slope_z", "law"))
            return (Parameter("support", "1", -0.05, 2.0, 0.02), *form, *more)
        return (Parameter("twice", "1", -0.05, 1.0, 0.05),)

    def bend(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        if place != "support":
            changes.twice += float(values[0])
            return
        changes.support += float(values[0])
        changes.support_rad += float(np.deg2rad(values[1]))
        changes.support_log_depth += float(values[2])
        x, z = changes.support_slope
        changes.support_slope = (x + float(values[3]), z + float(values[4]))
        changes.support_law += float(values[5])
