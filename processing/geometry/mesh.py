"""A triangle mesh in front of the camera, by ray casting (trimesh with embree)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

from processing.geometry.errors import GeometryError
from processing.threads import for_ranges

FloatArray = NDArray[np.float64]


class Mesh(BaseModel):
    """An STL, OBJ or PLY file, scaled to mm, turned, then moved.

    `rotation_deg` is a rotation vector in the world frame; `translation_mm` moves the file's origin off the
    centre of rotation. A mesh with holes is refused unless `allow_holes`: rays would pass to its inside.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["mesh"] = "mesh"
    file: str
    scale_mm: float = Field(default=1.0, gt=0)
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    translation_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    smooth_normals: bool = True
    allow_holes: bool = False

    def relative_to(self, folder: Path) -> Mesh:
        """The same mesh with its file looked up from `folder`."""
        return self.model_copy(update={"file": str(folder / self.file)})

    def to_world(self, points: FloatArray) -> FloatArray:
        """World coordinates in mm of points (..., 3) in the file's own."""
        turn = Rotation.from_rotvec(np.deg2rad(self.rotation_deg)).as_matrix()
        return np.asarray((points * self.scale_mm) @ turn.T + np.asarray(self.translation_mm))

    def intersect(
        self, origin_mm: FloatArray, rays: FloatArray, omega_deg: float
    ) -> tuple[NDArray[np.bool_], FloatArray, FloatArray]:
        """Nearest hits of rays (..., 3): mask (...), points (N, 3) in mm and unit normals (N, 3).

        Raises GeometryError when the file cannot be read or the mesh has holes.
        """
        del omega_deg
        world = self._world()
        flat = np.ascontiguousarray(rays.reshape(-1, 3))
        origin = np.asarray(origin_mm, dtype=float)
        face = _first_hits(world.scene, origin, flat)
        hit = face >= 0
        index = np.flatnonzero(hit)
        points, normal = np.empty((index.size, 3)), np.empty((index.size, 3))
        corners = world.corner_normals if self.smooth_normals else world.flat_normals
        for_ranges(
            index.size,
            lambda start, stop: _meet(
                index, face, flat, origin, world.triangles, world.face_normals, corners, points, normal, start, stop
            ),
        )
        return hit.reshape(rays.shape[:-1]), points, normal

    def occluded(self, points_mm: FloatArray, towards: FloatArray) -> NDArray[np.bool_]:
        """Whether the mesh itself stands between points (N, 3) and the directions (N, 3) towards the source."""
        world = self._world()
        start = points_mm + towards * (1e-4 * world.size_mm)
        return np.asarray(_first_hits(world.scene, start, towards) >= 0)

    def _world(self) -> _World:
        path = Path(self.file)
        try:
            stamp = path.stat().st_mtime_ns
        except OSError as error:
            raise GeometryError(f"{path}: no such mesh file ({error.strerror}). Check the path.") from error
        return _load(path, stamp, self.scale_mm, self.rotation_deg, self.translation_mm, self.allow_holes)


@dataclass(frozen=True)
class _World:
    """A mesh in world coordinates: arrays for the compiled loop, and embree's scene."""

    triangles: FloatArray
    face_normals: FloatArray
    corner_normals: FloatArray
    flat_normals: FloatArray
    size_mm: float
    scene: Any


@lru_cache(maxsize=4)
def _load(
    path: Path,
    stamp: int,
    scale_mm: float,
    rotation_deg: tuple[float, float, float],
    translation_mm: tuple[float, float, float],
    allow_holes: bool,
) -> _World:
    del stamp  # a part of the cache's key: the file may change
    import trimesh
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    try:
        mesh = trimesh.load_mesh(path)
    except (ValueError, TypeError, IndexError, KeyError, NotImplementedError) as error:
        raise GeometryError(f"{path} cannot be read as a mesh ({error}). STL, OBJ and PLY are.") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise GeometryError(f"{path} holds no triangles. Export it as a triangle mesh.")
    if not mesh.is_watertight and not allow_holes:
        raise GeometryError(
            f"{path} has holes ({len(mesh.faces)} triangles, not closed): rays would reach its inside. "
            "Close it in a mesh editor, or set allow_holes: true to take it as it is."
        )
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.deg2rad(rotation_deg)).as_matrix() * scale_mm
    matrix[:3, 3] = translation_mm
    mesh = mesh.copy()
    mesh.apply_transform(matrix)
    # Embree itself: trimesh's wrapper around it makes several copies of all rays.
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(mesh.triangles, dtype=np.float32))
    faces = np.ascontiguousarray(mesh.face_normals)
    return _World(
        triangles=np.ascontiguousarray(mesh.triangles),
        face_normals=faces,
        corner_normals=np.ascontiguousarray(mesh.vertex_normals[mesh.faces]),
        flat_normals=np.ascontiguousarray(np.repeat(faces[:, None], 3, axis=1)),
        size_mm=float(mesh.scale),
        scene=scene,
    )


def _first_hits(scene: Any, origin: FloatArray, rays: FloatArray) -> NDArray[np.int64]:
    # Index of the first triangle that each ray meets, -1 for none.
    origins = np.empty(rays.shape, dtype=np.float32)
    origins[:] = origin
    return np.asarray(scene.run(origins, rays.astype(np.float32)), dtype=np.int64)


@numba.njit(nogil=True, cache=True)
def _meet(index, face, rays, origin, triangles, face_normals, corner_normals, points, normals, start, stop):  # type: ignore[no-untyped-def]
    # Meet the plane of the triangle in double precision (embree's own distance is single), then weigh the normals
    # of its corners with barycentric coordinates, which are ratios of areas.
    for k in range(start, stop):
        ray = index[k]
        f = face[ray]
        n0, n1, n2 = face_normals[f, 0], face_normals[f, 1], face_normals[f, 2]
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        up = (a[0] - origin[0]) * n0 + (a[1] - origin[1]) * n1 + (a[2] - origin[2]) * n2
        t = up / (rays[ray, 0] * n0 + rays[ray, 1] * n1 + rays[ray, 2] * n2)
        x, y, z = origin[0] + t * rays[ray, 0], origin[1] + t * rays[ray, 1], origin[2] + t * rays[ray, 2]
        points[k, 0], points[k, 1], points[k, 2] = x, y, z
        wa = _area(b[0] - x, b[1] - y, b[2] - z, c[0] - x, c[1] - y, c[2] - z, n0, n1, n2)
        wb = _area(c[0] - x, c[1] - y, c[2] - z, a[0] - x, a[1] - y, a[2] - z, n0, n1, n2)
        wc = _area(a[0] - x, a[1] - y, a[2] - z, b[0] - x, b[1] - y, b[2] - z, n0, n1, n2)
        length = 0.0
        for i in range(3):
            v = wa * corner_normals[f, 0, i] + wb * corner_normals[f, 1, i] + wc * corner_normals[f, 2, i]
            normals[k, i] = v
            length += v * v
        length = np.sqrt(length)
        for i in range(3):
            normals[k, i] /= length


@numba.njit(inline="always")
def _area(px, py, pz, qx, qy, qz, n0, n1, n2):  # type: ignore[no-untyped-def]
    return (py * qz - pz * qy) * n0 + (pz * qx - px * qz) * n1 + (px * qy - py * qx) * n2
