"""Light that was scattered inside the volume behaves like a dipole's, not like a reflection at the surface.

Cause: small scatterers near the surface of a white, porous or pigmented material (PTFE, plaster, paper). The ratio
of the amplitudes across and along the plane of scattering is then cos(2 theta_d), Fresnel's for an index near one.
Mend: take the material's dominant process from measurement; a first-surface index near one imitates it.
"""

from processing.arrays import Array
from processing.effect import Parameter
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect


class VolumeScattering(ReflectanceEffect):
    """Share of the dipole's Jones matrix beside the first surface's, which has the same strength; 1 is all dipole."""

    fixed_parameters = (Parameter("share", "1", -1.0, 4.0, 0.2),)

    def bend(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        changes.volume += float(values[0])
