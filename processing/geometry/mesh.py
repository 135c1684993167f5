"""A triangle mesh in front of the camera, by ray casting (trimesh with embree)."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from processing.arrays import Array
from processing.computing.threads import for_ranges
from processing.doors import one_line, require_file
from processing.geometry.errors import GeometryError
from processing.section import Section

#: A million triangles as binary STL take 50 MB.
MOST_MESH_BYTES = 256 << 20
#: Rays that embree gets at a time.
RAYS = 1 << 15


class Mesh(Section):
    """An STL, OBJ or PLY file, scaled to mm, turned, then moved.

    `rotation_deg` is a rotation vector in the world frame; `translation_mm` moves the file's origin off the
    centre of rotation. A mesh with holes is refused unless `allow_holes`: rays would pass to its inside.
    """

    kind: Literal["mesh"] = "mesh"
    file: str = Field(description="file, relative to this one")
    scale_mm: float = Field(default=1.0, gt=0, description="mm for one unit of the mesh file")
    rotation_deg: tuple[float, float, float] = Field(
        default=(0.0, 0.0, 0.0), description="turns about x, y and z, degrees"
    )
    translation_mm: tuple[float, float, float] = Field(default=(0.0, 0.0, 0.0), description="shift after the turns, mm")
    smooth_normals: bool = Field(default=True, description="interpolate normals between the corners of a triangle")
    allow_holes: bool = Field(default=False, description="take a mesh that is not closed")

    def relative_to(self, folder: Path) -> "Mesh":
        """The same mesh with its file looked up from `folder`."""
        return self.model_copy(update={"file": str(folder / self.file)})

    def intersect(self, origin_mm: Array, rays: Array, omega_deg: float) -> tuple[NDArray[np.bool_], Array, Array]:
        """Nearest hits of rays (..., 3): mask (...), points (N, 3) in mm and unit normals (N, 3).

        Raises GeometryError when the file cannot be read or the mesh has holes.
        """
        del omega_deg
        # Late: only meshes need compiled loops, and every `acquire` imports this module.
        from processing.geometry.mesh_kernels import meet

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
            lambda start, stop: meet(
                index, face, flat, origin, world.triangles, world.face_normals, corners, points, normal, start, stop
            ),
        )
        if np.isfinite(points.sum()) and np.isfinite(normal.sum()):
            return hit.reshape(rays.shape[:-1]), points, normal
        sound = np.isfinite(points).all(axis=1) & np.isfinite(normal).all(axis=1)
        # What has no normal sends no light back that could be told.
        hit[index[~sound]] = False
        return hit.reshape(rays.shape[:-1]), points[sound], normal[sound]

    def occluded(self, points_mm: Array, towards: Array) -> NDArray[np.bool_]:
        """Whether the mesh itself stands between points (N, 3) and the directions (N, 3) towards the source."""
        world = self._world()
        start = points_mm + towards * (1e-4 * world.size_mm)
        return np.asarray(_first_hits(world.scene, start, towards) >= 0)

    def _world(self) -> "_World":
        path = Path(self.file)
        try:
            stamp = path.stat().st_mtime_ns
        except OSError as error:
            raise GeometryError(f"{path}: no such mesh file ({error.strerror}). Check the path.") from error
        return _load(
            path,
            stamp,
            self.scale_mm,
            self.rotation_deg,
            translation_mm=self.translation_mm,
            allow_holes=self.allow_holes,
        )


@dataclass(frozen=True)
class _World:
    """A mesh in world coordinates: arrays for the compiled loop, and embree's scene."""

    triangles: Array
    face_normals: Array
    corner_normals: Array
    flat_normals: Array
    size_mm: float
    scene: Any


@lru_cache(maxsize=4)
def _load(
    path: Path,
    stamp: int,
    scale_mm: float,
    rotation_deg: tuple[float, float, float],
    *,
    translation_mm: tuple[float, float, float],
    allow_holes: bool,
) -> _World:
    del stamp  # a part of the cache's key: the file may change
    try:
        import trimesh
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh
    except ImportError as error:
        raise GeometryError(f"{path}: a mesh needs trimesh and embreex. Type: pip install 'umov[paper]'") from error
    require_file(path, GeometryError, MOST_MESH_BYTES)
    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:
        # Readers of a dozen formats raise whatever they like.
        raise GeometryError(f"{path} cannot be read as a mesh ({one_line(error)}). STL, OBJ and PLY are.") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise GeometryError(f"{path} holds no triangles. Export it as a triangle mesh.")
    if mesh.vertices.shape[1:] != (3,) or not np.isfinite(mesh.vertices).all():
        raise GeometryError(f"{path} has corners that are not three finite numbers.")
    if not mesh.is_watertight and not allow_holes:
        raise GeometryError(
            f"{path} has holes ({len(mesh.faces)} triangles, not closed): rays would reach its inside. "
            "Close it in a mesh editor, or set allow_holes: true to take it as it is."
        )
    matrix = np.eye(4)
    matrix[:3, :3] = _turn(rotation_deg) * scale_mm
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


def _first_hits(scene: Any, origin: Array, rays: Array) -> NDArray[np.int32]:
    # Index of the first triangle that each ray (N, 3) from origin (3,) or (N, 3) meets, -1 for none. In chunks, because
    # embree wants single precision and the first touch of new memory for all rays costs a tenth of the time.
    count = len(rays)
    face = np.empty(count, dtype=np.int32)
    starts, directions = (np.empty((min(RAYS, count), 3), dtype=np.float32) for _ in range(2))
    for first in range(0, count, RAYS):
        last = min(first + RAYS, count)
        size = last - first
        starts[:size] = origin if origin.ndim == 1 else origin[first:last]
        directions[:size] = rays[first:last]
        face[first:last] = scene.run(starts[:size], directions[:size])
    return face


def _turn(rotation_deg: tuple[float, float, float]) -> Array:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(np.deg2rad(rotation_deg)).as_matrix())
