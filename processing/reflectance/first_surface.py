"""First-surface reflection alone: Fresnel at the facet halfway between source and camera.

Jarecki and Kupinski, Sec. III-B.
"""

from typing import Literal

from pydantic import Field

from processing.arrays import ComplexArray
from processing.geometry.frames import ScatteringGeometry
from processing.reflectance import fresnel
from processing.reflectance.base import Material, constants_at
from processing.section import Section


class Constants(Section):
    """Complex refractive index ratio n + i k at one wavelength."""

    n: float = Field(gt=0, description="refractive index")
    k: float = Field(default=0.0, ge=0, description="extinction coefficient")


class Model(Material):
    """Fresnel reflection; the surface's normal plays no part."""

    kind: Literal["first_surface"] = "first_surface"
    constants: dict[float, Constants] = Field(description="optical constants for each wavelength in nm")

    def jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> ComplexArray:
        """Jones matrices (..., 2, 2)."""
        c: Constants = constants_at(self.constants, wavelength_nm, self.name)
        return fresnel.jones(geometry, complex(c.n, c.k))
