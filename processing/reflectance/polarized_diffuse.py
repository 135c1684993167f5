"""First surface plus polarized diffuse reflection, added as Jones matrices (Jarecki and Kupinski, III-B to D)."""

from typing import Literal

import numpy as np
from pydantic import Field

from processing.arrays import ComplexArray
from processing.geometry.frames import ScatteringGeometry
from processing.reflectance import fresnel
from processing.reflectance.base import Material, constants_at
from processing.section import Section


class Constants(Section):
    """The four constants of a material at one wavelength: n + i k, and the weight a sin^b(theta_h)."""

    n: float = Field(gt=0, description="refractive index")
    k: float = Field(default=0.0, ge=0, description="extinction coefficient")
    a: float = Field(description="strength of the first surface's reflection")
    b: float = Field(gt=0, description="strength of the diffuse part")


def diffuse_jones(geometry: ScatteringGeometry) -> ComplexArray:
    """diag(1, -1) R(phi_d) diag(1, 0) R(-phi_d), (..., 2, 2); radial about the point where theta_h = 0."""
    phi = geometry.angles.phi_d
    c, s = np.cos(phi), np.sin(phi)
    jones = np.empty((*phi.shape, 2, 2), dtype=complex)
    jones[..., 0, 0], jones[..., 0, 1] = c * c, c * s
    jones[..., 1, 0], jones[..., 1, 1] = -c * s, -s * s
    return jones


class Model(Material):
    """J = F + a sin^b(theta_h) S."""

    kind: Literal["polarized_diffuse"] = "polarized_diffuse"
    constants: dict[float, Constants] = Field(description="optical constants for each wavelength in nm")

    def jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> ComplexArray:
        """Jones matrices (..., 2, 2)."""
        c: Constants = constants_at(self.constants, wavelength_nm, self.name)
        weight = c.a * np.sin(geometry.angles.theta_h) ** c.b
        return fresnel.jones(geometry, complex(c.n, c.k)) + weight[..., None, None] * diffuse_jones(geometry)
