"""What effects change in Jarecki and Kupinski's model of the dominant process, for a set of scattering geometries."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.geometry.frames import ScatteringGeometry, unit
from processing.polarization import mueller
from processing.reflectance import fresnel
from processing.reflectance.base import normalized_mueller
from processing.reflectance.polarized_diffuse import diffuse_jones

#: Refractive index so near one that only the ratio of the amplitudes is left.
DIPOLE = 1.0005 + 0j


@dataclass
class ReflectanceChanges:
    """Departure from first-surface reflection; all zero is the first surface alone.

    Attributes
    ----------
    diffuse_a, diffuse_log_b : weight a sin^b(theta_h) of polarized diffuse reflection, b = exp(diffuse_log_b).
    tilt_rad : turn of all normals about y and about x (a sphere or flat object that is registered off its place).
    arm_rad : the source stands this much further round than the arm says.
    generator_rad, analyzer_rad : the generator's polarization, and the whole analyzer, are turned by this.
    twice : weight of light that met two facets, relative to the dominant process.
    volume : share of a dipole's amplitudes in the first-surface term.
    index : added to the refractive index.

    What only an object in front of a camera has (`processing.diagnosis.surface.view`):
    centre_mm, scale : the sphere stands off its place by (x, y), and is larger by this part of its radius.
    support : irradiance of the object's middle by depolarized light from a disc below over that by the source.
    support_rad, support_log_depth : the disc's half angle is larger by this, and its depth by this factor (its log).
    support_slope : by how much the disc is brighter at its edge, along x and along z, relative to its middle.
    support_law : relative change, from theta_h 0 to 90 degrees, of the polarized light that the surface sends back.
    """

    diffuse_a: float = 0.0
    diffuse_log_b: float = 0.0
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    arm_rad: float = 0.0
    generator_rad: float = 0.0
    analyzer_rad: float = 0.0
    twice: float = 0.0
    volume: float = 0.0
    index: complex = 0j
    centre_mm: tuple[float, float] = (0.0, 0.0)
    scale: float = 0.0
    support: float = 0.0
    support_rad: float = 0.0
    support_log_depth: float = 0.0
    support_slope: tuple[float, float] = (0.0, 0.0)
    support_law: float = 0.0

    def dominant(self, geometry: ScatteringGeometry, index: complex) -> Array:
        """Dominant process (N, 4, 4), element 00 equal to 1, in the axes that the geometry states."""
        g, index = self._moved(geometry), index + self.index
        index = complex(max(index.real, 0.05), max(index.imag, 0.0))
        # At an index of one nothing is reflected; the ratio of the amplitudes has a limit there all the same.
        index = DIPOLE if abs(index - 1) < abs(DIPOLE - 1) else index
        jones = fresnel.jones(g, index)
        if self.volume:
            # Fresnel's ratio of amplitudes at an index near one is that of a dipole.
            dipole = fresnel.jones(g, DIPOLE)
            jones = (1 - self.volume) * jones + self.volume * (_strength(jones) / _strength(dipole)) * dipole
        if self.diffuse_a:
            weight = self.diffuse_a * np.sin(g.angles.theta_h) ** np.exp(self.diffuse_log_b)
            jones = jones + weight[..., None, None] * diffuse_jones(g)
        m = normalized_mueller(jones)
        if self.twice:
            again = m @ mueller.IDEAL_MIRROR @ m
            m = (m + self.twice * again / again[..., :1, :1]) / (1 + self.twice)
        if self.generator_rad:
            m = m @ mueller.rotation(self.generator_rad)
        if self.analyzer_rad:
            m = mueller.rotation(-self.analyzer_rad) @ m
        return np.asarray(m)

    def _moved(self, g: ScatteringGeometry) -> ScatteringGeometry:
        if not (any(self.tilt_rad) or self.arm_rad):
            return g
        normal = unit(_about_x(_about_y(g.normal, self.tilt_rad[0]), self.tilt_rad[1]))
        return ScatteringGeometry(normal, _about_y(g.to_source, self.arm_rad), g.to_camera, g.up)


def _strength(jones: NDArray[np.complex128]) -> Array:
    return np.asarray(np.sqrt(np.sum(np.abs(jones) ** 2, axis=(-2, -1), keepdims=True)))


def _about_y(v: Array, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * v[..., 0] + s * v[..., 2], v[..., 1], c * v[..., 2] - s * v[..., 0]], axis=-1)


def _about_x(v: Array, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([v[..., 0], c * v[..., 1] - s * v[..., 2], c * v[..., 2] + s * v[..., 1]], axis=-1)
