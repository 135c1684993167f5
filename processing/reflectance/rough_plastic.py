"""Two processes that add as Mueller matrices: rough first surface, and a volume that depolarizes.

Light is reflected by microfacets (GGX, Smith's shadowing), or refracted into the volume and out again with Fresnel's
transmittances of the smooth surface. Baek et al., ACM Trans. Graph. 37, 268 (2018); Walter et al., EGSR 2007.
"""

from typing import Literal

import numpy as np
from pydantic import Field

from processing.arrays import Array, ComplexArray
from processing.geometry.frames import ScatteringGeometry, cross, dot, unit
from processing.polarization import mueller
from processing.polarization.cloude import xi0_and_dominant
from processing.reflectance import fresnel
from processing.reflectance.base import Material, constants_at, normalized_mueller
from processing.section import Section


class Constants(Section):
    """Constants of a material at one wavelength."""

    n: float = Field(gt=1, description="refractive index")
    alpha: float = Field(gt=0, le=1, description="roughness: width of the distribution of facets (GGX)")
    albedo: float = Field(ge=0, le=1, description="part of the light in the volume that comes back")


class Model(Material):
    """Sum of a rough first surface and of a depolarizing volume under it."""

    kind: Literal["rough_plastic"] = "rough_plastic"
    constants: dict[float, Constants] = Field(description="optical constants for each wavelength in nm")

    def brdf(self, geometry: ScatteringGeometry, wavelength_nm: float) -> Array:
        """Mueller matrices (..., 4, 4) of both processes, in 1/sr; zero below the surface."""
        c: Constants = constants_at(self.constants, wavelength_nm, self.name)
        surface, volume = processes(geometry, c.n, c.alpha)
        return surface + c.albedo * volume

    def jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> ComplexArray:
        """Jones matrices (..., 2, 2) of the dominant process of the sum, of unit Frobenius norm."""
        vectors = np.linalg.eigh(mueller.coherency(self.mueller_jones(geometry, wavelength_nm)))[1][..., -1]
        return np.asarray(vectors.reshape(*vectors.shape[:-1], 2, 2))

    def mueller_jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> Array:
        """Dominant Mueller-Jones matrices (..., 4, 4) of the sum, element 00 equal to 1."""
        return np.asarray(xi0_and_dominant(self.brdf(geometry, wavelength_nm))[1], dtype=float)


def processes(geometry: ScatteringGeometry, n: float, alpha: float) -> tuple[Array, Array]:
    """Mueller matrices (..., 4, 4) in 1/sr of the rough surface, and of the volume for an albedo of 1."""
    cos_in, cos_out = (dot(geometry.normal, to) for to in (geometry.to_source, geometry.to_camera))
    lit = (cos_in > 0) & (cos_out > 0)
    shadow = _smith(cos_in, alpha) * _smith(cos_out, alpha)
    facets = alpha**2 / np.pi / (1 + np.square(np.cos(geometry.angles.theta_h)) * (alpha**2 - 1)) ** 2
    weight = np.divide(facets * shadow, 4 * cos_in * cos_out, out=np.zeros_like(shadow), where=lit)
    facet = fresnel.jones(geometry, complex(n))
    reflectance = np.sum(facet.real**2 + facet.imag**2, axis=(-2, -1)) / 2
    surface = (weight * reflectance)[..., None, None] * normalized_mueller(facet)
    enters = _transmittance(geometry.normal, geometry.to_source, geometry.axes_in, n)
    leaves = _transmittance(geometry.normal, geometry.to_camera, geometry.axes_out, n)
    volume = np.where(lit, 1 / np.pi, 0.0)[..., None, None] * leaves[..., :, None] * enters[..., None, :]
    return surface, volume


def _smith(cosine: Array, alpha: float) -> Array:
    """Part (...) of the facets that are not in the shadow of others."""
    c = np.clip(cosine, 1e-12, 1)
    return np.asarray(2 / (1 + np.sqrt(1 + alpha**2 * (1 / c**2 - 1))))


def _transmittance(normal: Array, to: Array, axes: tuple[Array, Array], n: float) -> Array:
    """Intensity (..., 4) that passes the smooth surface, as a function of the Stokes vector in `axes`."""
    rs, rp = fresnel.amplitudes(complex(n), np.arccos(np.clip(dot(normal, to), 0, 1)))
    ts, tp = 1 - np.abs(rs) ** 2, 1 - np.abs(rp) ** 2
    s = unit(cross(normal, to))
    x, y = (dot(s, axis) for axis in axes)
    return np.stack([(ts + tp) / 2, (ts - tp) / 2 * (x * x - y * y), (ts - tp) * x * y, np.zeros_like(ts)], axis=-1)
