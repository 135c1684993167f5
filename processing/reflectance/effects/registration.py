"""The place of the object in the image differs from the geometry, so every normal is wrong.

Cause: sphere centre or mesh pose from another session, camera nudged, wrong pixel scale.
Mend: register again on the outline (`process geometry`), put the object back on its pin.
"""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.geometry.sphere import Sphere
from processing.geometry.viewing import ViewingGeometry
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect


class Registration(ReflectanceEffect):
    """Offset in mm (x to the right, y up) and relative size of a sphere; of bare points, turn of all normals (degrees).

    Size stands for the camera's scale as well: one image cannot tell the two apart.
    """

    corrects = "geometry"
    advice = (
        "Find the sphere's outline in the image (`process campaign --register`): it fixes the registration by "
        "itself; a capture at another arm angle tells it from the arm's zero as well."
    )

    def places_on(self, shape: str) -> Sequence[str]:
        return ("sphere",) if shape == "sphere" else ("",)

    def parameters(self, place: str) -> tuple[Parameter, ...]:
        if place == "sphere":
            offsets = (Parameter(n, "mm", -2.0, 2.0, 0.2) for n in ("x", "y"))
            return (*offsets, Parameter("scale", "1", -0.1, 0.1, 0.01))
        return (Parameter("about_y", "degree", -10, 10, 0.5), Parameter("about_x", "degree", -10, 10, 0.5))

    def bend(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        if place != "sphere":
            about_y, about_x = np.deg2rad(values)
            changes.tilt_rad = (changes.tilt_rad[0] + float(about_y), changes.tilt_rad[1] + float(about_x))
            return
        x, y, scale = (float(v) for v in values)
        changes.centre_mm = (changes.centre_mm[0] + x, changes.centre_mm[1] + y)
        changes.scale += scale

    def corrected(self, view: ViewingGeometry, values: dict[str, float]) -> ViewingGeometry:
        if not isinstance(view.shape, Sphere):
            return view
        x, y, z = view.shape.centre_mm
        radius = view.shape.radius_mm * (1 + values["scale"])
        shape = Sphere(radius_mm=radius, centre_mm=(x + values["x"], y + values["y"], z))
        return view.model_copy(update={"shape": shape})
