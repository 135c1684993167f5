"""The dominant process at chosen pixels of an object, as a function of what its model and its geometry may lack."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay

from processing.arrays import Array
from processing.diagnosis.search.range_of import NEARLY_ZERO
from processing.errors import ProcessError
from processing.geometry.frames import ScatteringGeometry, dot, unit
from processing.geometry.pinhole import PinholeCamera
from processing.geometry.sphere import Sphere
from processing.geometry.viewing import ViewingGeometry
from processing.polarization import mueller
from processing.reflectance import first_surface, polarized_diffuse
from processing.reflectance.base import ReflectanceModel, constants_at
from processing.reflectance.changes import ReflectanceChanges

#: [degree] Half angle in which the middle of an object sees its support.
SUPPORT_DEG = 35.0
#: [half widths of the object] From its middle down to the support.
SUPPORT_DEPTH = 2.0

#: [parts] Of the support, a level disc.
SUPPORT_PARTS = 16
#: [pixels] Of a sphere, at one in so many of which the light of the support is computed.
EVERY = 13
#: [rad, fixed] Turn from one part of a disc to the next that spreads them evenly.
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
#: [answers] That are kept of each kind: a fit changes one value of many at a time.
KEPT = 64
#: [steps] Of theta_h in which the polarized light of a surface is learnt from its own pixels.
BINS = 16

Kept = TypeVar("Kept")


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
        *,
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
        self._forget()

    def _forget(self) -> None:
        self._geometries: dict[tuple[object, ...], ScatteringGeometry] = {}
        self._dominant: dict[tuple[object, ...], Array] = {}
        self._parts: dict[tuple[object, ...], list[ScatteringGeometry]] = {}
        self._below: dict[tuple[object, ...], Array] = {}
        self._between: Between | None = None

    def select(self, pixels: NDArray[np.bool_]) -> SurfaceView:
        """The same with some of the pixels alone."""
        subset = copy(self)
        subset.rays, subset.points, subset.normal = self.rays[pixels], self.points[pixels], self.normal[pixels]
        subset._forget()
        return subset

    def geometry(self, changes: ReflectanceChanges) -> ScatteringGeometry:
        """Directions at the pixels, for the sphere and the source where the changes put them."""
        key = changes.centre_mm, changes.scale, changes.arm_rad
        return _once(self._geometries, key, lambda: self._geometry(changes))

    def _geometry(self, changes: ReflectanceChanges) -> ScatteringGeometry:
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
        # Of an effect of the optics the surface knows nothing.
        return _once(
            self._dominant,
            _values(changes),
            lambda: self._complete(changes).dominant(self.geometry(changes), self.index),
        )

    def _complete(self, changes: ReflectanceChanges) -> ReflectanceChanges:
        log_b = changes.diffuse_log_b + float(np.log(self.b))
        # The arm's error is in the geometry already.
        return replace(changes, diffuse_a=changes.diffuse_a + self.a, diffuse_log_b=log_b, arm_rad=0.0)

    def learn_polarized(self, alpha_0: Array, weight: Array) -> None:
        """Take from the pixels the polarized light (P,) that the surface sends back for an irradiance, over theta_h."""
        g = self.geometry(ReflectanceChanges())
        theta, cosine = g.angles.theta_h, dot(g.normal, g.to_source)
        edges = np.quantile(theta, np.linspace(0, 1, BINS + 1))
        bins = np.clip(np.searchsorted(edges, theta, side="right") - 1, 0, BINS - 1)
        total = np.maximum(np.bincount(bins, weight, BINS), 1e-300)
        self._theta_h = np.bincount(bins, weight * theta, BINS) / total
        lit = np.maximum(np.bincount(bins, weight * cosine**2, BINS), 1e-300)
        self._alpha_0 = np.bincount(bins, weight * cosine * alpha_0, BINS) / lit

    def extra(self, changes: ReflectanceChanges) -> Array | None:
        """Mueller matrices (P, 4, 4) of light that came from the support, in the units of alpha_0; None without it."""
        if not changes.support:
            return None
        # Of what else may be wrong only the material counts here: the rest changes a small term by a little.
        material = ReflectanceChanges(
            diffuse_a=changes.diffuse_a,
            diffuse_log_b=changes.diffuse_log_b,
            index=changes.index,
            volume=changes.volume,
            support_rad=changes.support_rad,
            support_log_depth=changes.support_log_depth,
        )
        below = _once(self._below, _values(material), lambda: self._from_below(material))
        slope = 1 + _disc(0.0, 1.0)[:, ::2] @ np.array(changes.support_slope)
        column = np.einsum("l,t,ltpi->pi", [1.0, changes.support_law], slope, below)
        light = np.zeros((len(self.points), 4, 4))
        # The support's light is not polarized.
        light[..., 0] = changes.support * (column if self._between is None else self._between(column))
        return mueller.rotation(-changes.analyzer_rad) @ light if changes.analyzer_rad else light

    def _from_below(self, changes: ReflectanceChanges) -> Array:
        """Stokes vectors (2, parts, S, 4) of each part's light at the nodes, and times theta_h over 90 degrees."""
        if self._between is None and isinstance(self.view.shape, Sphere):
            self._between = Between(self.rays[:, :2] / self.rays[:, 2:])
        some = slice(None) if self._between is None else self._between.nodes
        points, g, complete = self.points[some], self.geometry(ReflectanceChanges())[some], self._complete(changes)
        shape = self.view.shape
        middle = np.asarray(shape.centre_mm) if isinstance(shape, Sphere) else self.points.mean(axis=0)
        half_width = shape.radius_mm if isinstance(shape, Sphere) else float(np.ptp(self.points[:, 0])) / 2
        depth, disc = _support(half_width, changes)
        columns = np.zeros((2, SUPPORT_PARTS, len(points), 4))
        ways = [part - points for part in middle + disc]
        parts = _once(
            self._parts,
            (changes.support_rad, changes.support_log_depth),
            lambda: [ScatteringGeometry(g.normal, unit(way), g.to_camera) for way in ways],
        )
        for k, (way, below) in enumerate(zip(ways, parts, strict=True)):
            # A part shines and is seen under the same angle.
            weight = np.maximum(dot(g.normal, below.to_source), 0.0) * np.maximum(-below.to_source[:, 1], 0.0)
            weight = weight * depth**2 / dot(way, way) / SUPPORT_PARTS
            theta_h = below.angles.theta_h
            weight = weight * np.interp(theta_h, self._theta_h, self._alpha_0)
            columns[0, k] = weight[:, None] * complete.dominant(below, self.index)[..., 0]
            columns[1, k] = (theta_h / (np.pi / 2))[:, None] * columns[0, k]
        return columns


def _values(changes: ReflectanceChanges) -> tuple[object, ...]:
    # They are numbers and tuples of numbers, which `astuple` would copy one by one.
    return tuple(vars(changes).values())


def _once(cache: dict[tuple[object, ...], Kept], key: tuple[object, ...], make: Callable[[], Kept]) -> Kept:
    """The cached value of a key; computed if it is not cached yet."""
    if key not in cache:
        if len(cache) >= KEPT:
            cache.clear()
        cache[key] = make()
    return cache[key]


class Between:
    """Linear interpolation of what is smooth over a sphere, from some of its pixels to all.

    Attributes
    ----------
    nodes : (S,) numbers of the pixels at which values have to be given.
    """

    def __init__(self, where: Array) -> None:
        self.nodes = np.union1d(np.arange(0, len(where), EVERY), ConvexHull(where).vertices)
        grid = Delaunay(where[self.nodes])
        inside = np.maximum(grid.find_simplex(where, tol=NEARLY_ZERO), 0)
        first = np.einsum("pij,pj->pi", grid.transform[inside, :2], where - grid.transform[inside, 2])
        self._weights = np.column_stack([first, 1 - first.sum(axis=1)])
        self._corners = grid.simplices[inside]

    def __call__(self, values: Array) -> Array:
        """Values (P, ...) at all pixels of values (S, ...) at the nodes."""
        return np.asarray(np.einsum("pi,pi...->p...", self._weights, values[self._corners]))


def _support(half_width_mm: float, changes: ReflectanceChanges) -> tuple[float, Array]:
    """Depth of the support below the middle of an object, and the middles (SUPPORT_PARTS, 3) of its parts, in mm."""
    depth = SUPPORT_DEPTH * half_width_mm * np.exp(changes.support_log_depth)
    return depth, _disc(depth, depth * np.tan(np.deg2rad(SUPPORT_DEG) + changes.support_rad))


def _disc(depth_mm: float, radius_mm: float) -> Array:
    """Middles (SUPPORT_PARTS, 3) of equal parts of a level disc below the origin."""
    k = np.arange(SUPPORT_PARTS) + 0.5
    turn, ring = GOLDEN_ANGLE * k, radius_mm * np.sqrt(k / SUPPORT_PARTS)
    return np.stack([ring * np.cos(turn), np.full_like(k, -depth_mm), ring * np.sin(turn)], axis=1)


def material_constants(material: ReflectanceModel, wavelength_nm: float) -> tuple[complex, float, float]:
    """n + i k, a and b of a material at a wavelength; a = 0 and b = 2 for a first surface alone.

    Raises ProcessError: a kind of material that the effects cannot act on.
    """
    if isinstance(material, first_surface.Model):
        plain = constants_at(material.constants, wavelength_nm, material.name)
        return complex(plain.n, plain.k), 0.0, 2.0
    if isinstance(material, polarized_diffuse.Model):
        c = constants_at(material.constants, wavelength_nm, material.name)
        return complex(c.n, c.k), c.a, c.b
    kind = getattr(material, "kind", type(material).__name__)
    raise ProcessError(f"effects of the reflectance act on first_surface and polarized_diffuse, not on {kind!r}.")
