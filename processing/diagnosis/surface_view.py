"""The dominant process at chosen pixels of an object, as a function of what its model and its geometry may lack."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from processing import mueller
from processing.errors import ProcessError
from processing.geometry.frames import ScatteringGeometry, dot, unit
from processing.geometry.pinhole import PinholeCamera
from processing.geometry.sphere import Sphere
from processing.geometry.viewing import ViewingGeometry
from processing.reflectance import first_surface, polarized_diffuse
from processing.reflectance.base import ReflectanceModel, constants_at
from processing.reflectance_changes import ReflectanceChanges

Array = NDArray[np.float64]

#: Direction from the object to its support; just off the vertical, where the axes of a beam have no direction.
SUPPORT: Array = unit([0.0, -1.0, 1e-3])
#: Steps of theta_h in which the polarized light of a surface is learnt from its own pixels.
BINS = 16


class SurfaceView:
    """Pixels (P,) of one capture that see the object.

    Parameters
    ----------
    view : geometry as its file states it.
    camera : with the grid of the pixels.
    pixels : (rows, columns) True where a pixel is used; all of them must see the object.
    omega_deg : arm angle as read.
    """

    def __init__(
        self,
        view: ViewingGeometry,
        camera: PinholeCamera,
        pixels: NDArray[np.bool_],
        omega_deg: float,
        material: ReflectanceModel,
        wavelength_nm: float,
    ) -> None:
        self.view, self.omega_deg = view, omega_deg
        self.index, self.a, self.b = material_constants(material, wavelength_nm)
        self.eye = camera.position_mm
        self.rays = camera.rays()[pixels]
        # What is not a sphere stands as its file says; an error of the arm moves the source alone.
        _, self.points, self.normal = view.shape.intersect(self.eye, self.rays, omega_deg)
        self._theta_h, self._alpha_0 = np.zeros(1), np.zeros(1)

    def geometry(self, changes: ReflectanceChanges) -> ScatteringGeometry:
        """Directions at the pixels, for the sphere and the source where the changes put them."""
        points, normal = self.points, self.normal
        if isinstance(self.view.shape, Sphere) and (any(changes.centre_mm) or changes.scale):
            points, normal = self._on_sphere(self.view.shape, changes)
        source = self.view.source_position_mm(self.omega_deg + float(np.rad2deg(changes.arm_rad)))
        return ScatteringGeometry(normal, unit(source - points), unit(self.eye - points))

    def _on_sphere(self, sphere: Sphere, changes: ReflectanceChanges) -> tuple[Array, Array]:
        centre = np.asarray(sphere.centre_mm) + np.array([*changes.centre_mm, 0.0])
        radius = sphere.radius_mm * (1 + changes.scale)
        to_centre = centre - self.eye
        along = self.rays @ to_centre
        gap = along**2 - (to_centre @ to_centre - radius**2)
        # A pixel that would miss the moved sphere takes its rim: the sum of squares stays smooth.
        points = self.eye + self.rays * (along - np.sqrt(np.maximum(gap, 0.0)))[:, None]
        return points, unit(points - centre)

    def dominant(self, changes: ReflectanceChanges) -> Array:
        """Dominant process (P, 4, 4), element 00 equal to 1, in the instrument frames."""
        return self._complete(changes).dominant(self.geometry(changes), self.index)

    def _complete(self, changes: ReflectanceChanges) -> ReflectanceChanges:
        log_b = changes.diffuse_log_b + float(np.log(self.b))
        # The arm's error is in the geometry already.
        return replace(changes, diffuse_a=changes.diffuse_a + self.a, diffuse_log_b=log_b, arm_rad=0.0)

    def learn_polarized(self, alpha_0: Array, weight: Array) -> None:
        """Take from the pixels how much polarized light (P,) the surface sends back, as a function of theta_h."""
        theta = self.geometry(ReflectanceChanges()).angles.theta_h
        edges = np.quantile(theta, np.linspace(0, 1, BINS + 1))
        bins = np.clip(np.searchsorted(edges, theta, side="right") - 1, 0, BINS - 1)
        total = np.maximum(np.bincount(bins, weight, BINS), 1e-300)
        self._theta_h = np.bincount(bins, weight * theta, BINS) / total
        self._alpha_0 = np.bincount(bins, weight * alpha_0, BINS) / total

    def extra(self, changes: ReflectanceChanges) -> Array | None:
        """Mueller matrices (P, 4, 4) of light that came from the support, in the units of alpha_0; None without it."""
        if not changes.support:
            return None
        g = self.geometry(changes)
        below = ScatteringGeometry(g.normal, np.broadcast_to(SUPPORT, g.normal.shape), g.to_camera)
        weight = changes.support * np.maximum(dot(g.normal, SUPPORT), 0.0)
        weight = weight * np.interp(below.angles.theta_h, self._theta_h, self._alpha_0)
        m = self._complete(changes).dominant(below, self.index) @ mueller.IDEAL_DEPOLARIZER
        return np.asarray(weight[:, None, None] * m)


def material_constants(material: ReflectanceModel, wavelength_nm: float) -> tuple[complex, float, float]:
    """n + i k, a and b of a material at a wavelength; a = 0 and b = 2 for a first surface alone.

    Raises
    ------
    ProcessError : a kind of material that the effects cannot act on.
    """
    if isinstance(material, first_surface.Model):
        plain = constants_at(material.constants, wavelength_nm, material.name)
        return complex(plain.n, plain.k), 0.0, 2.0
    if isinstance(material, polarized_diffuse.Model):
        c = constants_at(material.constants, wavelength_nm, material.name)
        return complex(c.n, c.k), c.a, c.b
    kind = getattr(material, "kind", type(material).__name__)
    raise ProcessError(f"effects of the reflectance act on first_surface and polarized_diffuse, not on {kind!r}.")
