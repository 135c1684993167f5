"""The surface also reflects diffusely with some polarization, which first-surface reflection alone does not have.

Cause: light that entered, scattered and left again is partly polarized by the last refraction (paper, Sec. III-C).
Mend: use a `polarized_diffuse` material in place of `first_surface`; fit its a and b at several geometries.
"""

from __future__ import annotations

from processing.arrays import Array
from processing.instrument.changes import Conditions
from processing.instrument.effects.base import Parameter
from processing.instrument.model import InstrumentModel
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import ReflectanceEffect


class This(ReflectanceEffect):
    """Weight a sin^b(theta_h) of the diffuse term in the Jones matrix; log_b = ln b."""

    bent = True

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return (Parameter("a", "1", -2.0, 2.0, 0.1), Parameter("log_b", "1", -1.5, 2.0, 0.5))

    def bend(self, changes: ReflectanceChanges, values: Array) -> None:
        changes.diffuse_a += float(values[0])
        changes.diffuse_log_b += float(values[1])
