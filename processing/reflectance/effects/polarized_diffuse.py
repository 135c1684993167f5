"""The surface also reflects diffusely with some polarization, which first-surface reflection alone does not have.

Cause: light that enters, scatters and emerges is partly polarized by the last refraction (paper, Sec. III-C).
Mend: use a `polarized_diffuse` material instead of `first_surface`; fit its a and b at several geometries.
"""

from dataclasses import replace

from processing.arrays import Array
from processing.effect import Parameter
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect


class PolarizedDiffuse(ReflectanceEffect):
    """Weight a sin^b(theta_h) of the diffuse term in the Jones matrix; log_b = ln b."""

    corrects = "material"
    has_bent_valley = True
    fixed_parameters = (Parameter("a", "1", -2.0, 2.0, 0.1), Parameter("log_b", "1", -1.5, 2.0, 0.5))

    def bend(self, changes: ReflectanceChanges, place: str, values: Array) -> None:
        changes.diffuse_a += float(values[0])
        changes.diffuse_log_b += float(values[1])

    def physical(self, parameters: tuple[Parameter, ...], index: complex, a: float) -> tuple[Parameter, ...]:
        # The weight of the material cannot become negative.
        weight, log_b = parameters
        return replace(weight, lower=max(weight.lower, -a - 1e-9)), log_b
