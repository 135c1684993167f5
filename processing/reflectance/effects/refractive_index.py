"""The surface's refractive index differs from the material file.

Cause: an index from a table for another batch, wavelength, paint or finish; an oxide or an oil film.
Mend: fit it (`process fit-material`), or measure it on a polished piece with an ellipsometer.
"""

from dataclasses import replace

from processing.arrays import Array
from processing.effect import Parameter
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect


class RefractiveIndex(ReflectanceEffect):
    """What has to be added to n and k; more than these bounds is another material, or no first surface at all."""

    corrects = "material"
    has_bent_valley = True
    fixed_parameters = (Parameter("n", "1", -0.3, 0.3, 0.05), Parameter("k", "1", -0.3, 0.3, 0.05))

    def bend(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        changes.index += complex(*values)

    def physical(self, parameters: tuple[Parameter, ...], index: complex, a: float) -> tuple[Parameter, ...]:
        # The material cannot amplify light.
        n, k = parameters
        return n, replace(k, lower=max(k.lower, -index.imag - 1e-9))
