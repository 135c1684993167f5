"""The true dominant process of a simulated surface, traced with electric fields in three dimensions.

The same physics as `processing.reflectance` (Jarecki and Kupinski) by another way, so that what is processed is
not what was simulated: boundary conditions for the tangential field in place of r_s and r_p, transversality in place of
the axes p, vectors in place of phi_d, and a Mueller matrix put together from the Stokes vectors of four beams.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from processing.arrays import Array, ComplexArray
from processing.geometry.frames import ScatteringGeometry
from processing.reflectance import first_surface, polarized_diffuse
from processing.reflectance.base import ReflectanceModel, constants_at

#: Beams sent in: horizontal, vertical, 45 degrees, right circular; components along x and y of the generator.
BEAMS: tuple[tuple[complex, complex], ...] = (
    (1, 0),
    (0, 1),
    (np.sqrt(0.5), np.sqrt(0.5)),
    (np.sqrt(0.5), -1j * np.sqrt(0.5)),
)


@dataclass(frozen=True)
class TracedSurface:
    """A material of the kinds `first_surface` and `polarized_diffuse` as light meets it."""

    material: first_surface.Model | polarized_diffuse.Model

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """Wavelengths at which the material is given."""
        return self.material.wavelengths_nm

    def jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> ComplexArray:
        """Jones matrices (..., 2, 2), not normalized."""
        c = constants_at(self.material.constants, wavelength_nm, self.material.name)
        g, facet = geometry, geometry.to_source + geometry.to_camera
        facet = facet / np.sqrt(_dot(facet, facet))[..., None]
        # Two beams at once, polarized along x and y of the generator.
        fields = np.stack(_axes(-g.to_source)).astype(complex)
        reflected = _mirrored(fields, g.to_source, facet, complex(c.n, c.k))
        out = np.stack([_dot(reflected, axis) for axis in _axes(g.to_camera)])
        if a := getattr(c, "a", 0.0):
            u, sine = _outwards(g, facet)
            weight = a * sine**c.b
            out[0] += weight * u[0] * u
            out[1] -= weight * u[1] * u
        return np.moveaxis(out, (0, 1), (-2, -1))

    def mueller_jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> Array:
        """Mueller-Jones matrices (..., 4, 4) with element 00 equal to 1."""
        j = self.jones(geometry, wavelength_nm)
        h, v, d, r = (_stokes(j[..., 0] * x + j[..., 1] * y) for x, y in BEAMS)
        mean = (h + v) / 2
        m = np.stack([mean, (h - v) / 2, d - mean, r - mean], axis=-1)
        return np.asarray(m / m[..., :1, :1])


def trace_surface(material: ReflectanceModel) -> ReflectanceModel:
    """The traced surface of a material; one of another kind as it is."""
    if isinstance(material, first_surface.Model | polarized_diffuse.Model):
        return TracedSurface(material)
    return material


def _outwards(g: ScatteringGeometry, facet: Array) -> tuple[Array, Array]:
    """Axis (2, ...) of the polarizer that diffuse light meets, away from where facet and surface agree; sin theta_h."""
    cosine = _dot(facet, g.normal)
    outward = facet * cosine[..., None] - g.normal
    sine = np.sqrt(_dot(outward, outward))
    flat = g.to_source - facet * _dot(g.to_source, facet)[..., None]
    u = np.stack([_dot(flat, outward), _dot(flat, np.cross(facet, outward))])
    length = np.hypot(u[0], u[1])
    # Where there is no such direction its weight is zero as well.
    return np.divide(u, length, out=np.zeros_like(u), where=length > 0), sine


def _mirrored(field: ComplexArray, to_source: Array, facet: Array, index: complex) -> ComplexArray:
    """Field (..., 3) that a facet sends back, from the tangential parts on both sides (admittances)."""
    cosine = _dot(to_source, facet)[..., None]
    # Tangential wave vector of incoming and reflected light, in units of 2 pi over the wavelength outside.
    along = facet * cosine - to_source
    square = _dot(along, along)[..., None]
    inside = np.sqrt(1 - square / index**2 + 0j)
    tangential = field - facet * _dot(field, facet)[..., None]
    direction = along / np.sqrt(np.where(square > 0, square, 1.0))
    in_plane = direction * _dot(tangential, direction)[..., None]
    in_plane_share = (inside - index * cosine) / (inside + index * cosine)
    across_share = (cosine - index * inside) / (cosine + index * inside)
    reflected = in_plane * in_plane_share + (tangential - in_plane) * across_share
    # E is at right angles to the way of the wave: along . E + cosine E_n = 0.
    return np.asarray(reflected - facet * (_dot(along, reflected)[..., None] / cosine))


def _dot(a: Any, b: Any) -> Any:
    return np.einsum("...i,...i->...", a, b)


def _axes(k: Array) -> tuple[Array, Array]:
    """x = unit(y cross k), and y = k cross x, for a propagation k."""
    level = np.hypot(k[..., 0], k[..., 2])
    zero = np.zeros_like(level)
    x = np.stack([k[..., 2] / level, zero, -k[..., 0] / level], axis=-1)
    return x, np.stack([-k[..., 1] * k[..., 0] / level, level, -k[..., 1] * k[..., 2] / level], axis=-1)


def _stokes(e: ComplexArray) -> Array:
    """Stokes vector (..., 4) of fields (..., 2), decreasing phase: right circular is (1, -i)/sqrt 2."""
    x, y = e[..., 0], e[..., 1]
    power_x, power_y, cross = np.abs(x) ** 2, np.abs(y) ** 2, x * np.conj(y)
    return np.stack([power_x + power_y, power_x - power_y, 2 * cross.real, 2 * cross.imag], axis=-1)
