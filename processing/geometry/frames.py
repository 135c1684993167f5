"""Directions at surface points, and the transverse axes to which their Mueller matrices refer.

World frame: origin at the centre of rotation, y up, camera on +z (docs/conventions.md, "Frames"). Each beam has
x = unit(up cross k) and y = k cross x, k being its propagation. With up = y these are the instrument frames
that a measured Mueller image is in; with up = n they are Jarecki and Kupinski's normal-based ones, which turn with the
surface (docs/conventions.md); with up = h, x is the axis s of the facet for both beams, as in a renderer's table.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from processing.arrays import Array
from processing.geometry import rusinkiewicz
from processing.polarization import mueller

WORLD_UP: Array = np.array([0.0, 1.0, 0.0])


def unit(v: ArrayLike) -> Array:
    """Vectors (..., 3) at unit length; a zero vector stays zero."""
    a = np.asarray(v, dtype=np.float64)
    length = np.sqrt(np.einsum("...i,...i->...", a, a))[..., None]
    return np.asarray(np.divide(a, length, out=np.zeros_like(a), where=length > 0))


def dot(a: ArrayLike, b: ArrayLike) -> Array:
    """Scalar products (...) of vectors (..., 3)."""
    return np.asarray(np.einsum("...i,...i->...", np.asarray(a), np.asarray(b)))


def cross(a: ArrayLike, b: ArrayLike) -> Array:
    """Vector products (..., 3) over the last axis (several times faster than numpy's general one)."""
    u, v = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    product = np.empty(u.shape)
    product[..., 0] = u[..., 1] * v[..., 2] - u[..., 2] * v[..., 1]
    product[..., 1] = u[..., 2] * v[..., 0] - u[..., 0] * v[..., 2]
    product[..., 2] = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    return product


@dataclass(frozen=True)
class ScatteringGeometry:
    """Unit vectors at surface points.

    Attributes
    ----------
    normal, to_source, to_camera : (..., 3), outward normal n, and wi, wo from the point.
    up : (3,) or (..., 3), the direction that fixes the transverse axes of both beams.
    """

    normal: Array
    to_source: Array
    to_camera: Array
    up: Array = field(default_factory=WORLD_UP.copy)

    @cached_property
    def half(self) -> Array:
        """h (..., 3), unit half vector of wi and wo."""
        return unit(self.to_source + self.to_camera)

    @cached_property
    def angles(self) -> rusinkiewicz.Angles:
        """theta_h, theta_d, phi_d, each (...), radians."""
        return rusinkiewicz.angles(self.normal, self.to_source, self.to_camera)

    @cached_property
    def s_axis(self) -> Array:
        """s = unit(h cross wi), (..., 3); where source and camera coincide any transverse axis serves: `up`."""
        s = cross(self.half, self.to_source)
        length = np.sqrt(dot(s, s))
        alike = length < 1e-9
        if np.any(alike):
            up = np.broadcast_to(self.up, s.shape)
            s = np.where(alike[..., None], up - self.half * dot(up, self.half)[..., None], s)
        return unit(s)

    @cached_property
    def axes_in(self) -> tuple[Array, Array]:
        """x, y of the generator's beam, each (..., 3); ki = -wi."""
        return transverse_axes(-self.to_source, self.up)

    @cached_property
    def axes_out(self) -> tuple[Array, Array]:
        """x, y of the analyzer's beam, each (..., 3); ko = wo."""
        return transverse_axes(self.to_camera, self.up)

    def with_up(self, up: ArrayLike) -> "ScatteringGeometry":
        """The same directions, referred to other transverse axes."""
        return ScatteringGeometry(self.normal, self.to_source, self.to_camera, np.asarray(up, dtype=np.float64))

    def reversed(self) -> "ScatteringGeometry":
        """Source and camera exchanged (for reciprocity)."""
        return ScatteringGeometry(self.normal, self.to_camera, self.to_source, self.up)

    def __getitem__(self, index: Any) -> "ScatteringGeometry":
        """The points that `index` picks (any numpy index of the leading axes)."""
        up = self.up if self.up.ndim == 1 else self.up[index]
        return ScatteringGeometry(self.normal[index], self.to_source[index], self.to_camera[index], up)


@dataclass(frozen=True)
class GeometryImage:
    """Scattering geometry of the pixels of an image that see the object.

    Attributes
    ----------
    mask : (rows, columns), pixels that see a lit point of the object.
    points : geometry of those pixels, in row-major order, N = mask.sum().
    visible : (rows, columns), pixels that see the object at all, its shadowed parts included.
    """

    mask: NDArray[np.bool_]
    points: ScatteringGeometry
    visible: NDArray[np.bool_]

    def fill(self, values: ArrayLike, outside: float = np.nan) -> NDArray[np.floating]:
        """Image (rows, columns, ...) of values (N, ...); `outside` elsewhere."""
        v = np.asarray(values)
        image = np.full((*self.mask.shape, *v.shape[1:]), outside, dtype=v.dtype)
        image[self.mask] = v
        return image


def transverse_axes(k: Array, up: Array = WORLD_UP) -> tuple[Array, Array]:
    """x = unit(up cross k) and y = k cross x for propagation directions k (..., 3)."""
    x = unit(cross(up, k))
    return x, cross(k, x)


def change_frames(m: ArrayLike, geometry: ScatteringGeometry, up: ArrayLike) -> Array:
    """Mueller matrices (..., 4, 4) given in the geometry's axes, referred to the axes that `up` fixes."""
    turn_out, turn_in = frame_turns(geometry, up)
    return np.asarray(turn_out @ np.asarray(m, dtype=np.float64) @ turn_in)


def frame_turns(geometry: ScatteringGeometry, up: ArrayLike) -> tuple[Array, Array]:
    """Matrices (..., 4, 4) between which a Mueller matrix stands to be referred to the axes that `up` fixes."""
    target = geometry.with_up(up)
    turn_in = _turn(-geometry.to_source, geometry.axes_in[0], target.axes_in[0])
    turn_out = _turn(geometry.to_camera, geometry.axes_out[0], target.axes_out[0])
    return mueller.rotation(-turn_out), mueller.rotation(turn_in)


def _turn(k: Array, x_from: Array, x_to: Array) -> Array:
    # Counter-clockwise angle about k, that is, as seen looking into the beam.
    return np.asarray(np.arctan2(dot(k, cross(x_from, x_to)), dot(x_from, x_to)))
