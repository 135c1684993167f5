"""Refine the pose of a mesh so that its silhouette meets the object's outline in an image."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_erosion, distance_transform_edt, map_coordinates
from scipy.spatial.transform import Rotation

from processing.arrays import Array
from processing.computing.filters import gaussian
from processing.geometry.errors import OutlineNotFound
from processing.geometry.frames import unit
from processing.geometry.mesh import Mesh
from processing.geometry.pinhole import PinholeCamera

#: Where the outline runs between pixels is known to about this; it moves all of the outline at once.
OUTLINE_BIAS_PX = 0.15
MOST_STEPS = 40

#: A direction of the pose whose singular value is smaller than this part of the largest is left alone.
IDENTIFIABLE = 0.02


@dataclass(frozen=True)
class PoseFit:
    """A refined pose.

    Attributes
    ----------
    mesh : with the new rotation and translation.
    residual_px : root mean square distance between the two outlines.
    identifiable : how many of the six directions of the pose the outline fixes.
    stderr : (6,), standard errors of the small rotation (degrees) and the shift (mm) within those directions,
        from the scatter of the outline and from a bias of `OUTLINE_BIAS_PX` all around.
    """

    mesh: Mesh
    residual_px: float
    identifiable: int
    stderr: Array
    steps: int


def refine_pose(mesh: Mesh, camera: PinholeCamera, silhouette: ArrayLike) -> PoseFit:
    """Turn and move the mesh until its rim projects onto the outline of `silhouette`.

    Parameters
    ----------
    silhouette : (rows, columns) bool, all pixels that show the object, its shadowed parts included;
        its size is the image size of `camera`.
    mesh : start pose, within a few degrees and a few per cent of its size.

    Raises
    ------
    OutlineNotFound
        The silhouette is empty or cut by the frame, or the start pose does not overlap it.
    """
    mask = np.asarray(silhouette, dtype=bool)
    if mask.shape != (camera.rows, camera.columns):
        raise ValueError(f"silhouette {mask.shape} and camera {(camera.rows, camera.columns)} differ in size")
    if not mask.any():
        raise OutlineNotFound("the silhouette is empty: no pixel shows the object")
    if mask[[0, -1]].any() or mask[:, [0, -1]].any():
        raise OutlineNotFound("the silhouette touches the border of the frame: the outline is not whole")
    distance = _signed_distance(mask)
    previous = np.inf
    for step in range(1, MOST_STEPS + 1):
        rim, normal, overlap = _rim(mesh, camera, mask)
        if overlap < 0.3:
            raise OutlineNotFound(
                f"mesh and object overlap by {100 * overlap:.0f} % of the silhouette: start from a closer pose"
            )
        residual = _sample(distance, camera.project(rim))
        jacobian = _jacobian(rim, normal, mesh, camera)
        u, s, vt = np.linalg.svd(jacobian, full_matrices=False)
        keep = s > IDENTIFIABLE * s[0]
        move = -(vt.T[:, keep] / s[keep]) @ (u.T[keep] @ residual)
        rms = float(np.sqrt(np.mean(residual**2)))
        if rms > previous * 0.999 and step > 3 and np.linalg.norm(move) < 1e-2:
            break
        previous = rms
        mesh = _moved(mesh, move, _size(rim, np.asarray(mesh.translation_mm)))
    inverse = vt.T[:, keep] / s[keep]
    # Neighbouring rim points share pixels through the blur, about three of them each.
    scatter = np.sqrt(3 * np.sum(inverse**2, axis=1)) * rms
    bias = inverse @ (u.T[keep] @ np.full(len(residual), OUTLINE_BIAS_PX))
    error = np.hypot(scatter, bias)
    error[:3] = np.rad2deg(error[:3] / _size(rim, np.asarray(mesh.translation_mm)))
    return PoseFit(mesh, rms, int(keep.sum()), error, step)


def _signed_distance(mask: NDArray[np.bool_]) -> Array:
    # Positive outside; the border runs half way between a pixel inside and one outside.
    inside, outside = distance_transform_edt(mask), distance_transform_edt(~mask)
    signed = np.where(mask, 0.5 - inside, outside - 0.5)
    return np.asarray(gaussian(signed, 1.0))


def _rim(mesh: Mesh, camera: PinholeCamera, mask: NDArray[np.bool_]) -> tuple[Array, Array, float]:
    hit, points, normals = mesh.intersect(camera.position_mm, camera.rays(), 0.0)
    if not hit.any():
        raise OutlineNotFound("the mesh is not in the frame at its start pose. Check its scale and translation.")
    rim = hit & ~binary_erosion(hit, border_value=1)
    index = np.full(hit.shape, -1)
    index[hit] = np.arange(hit.sum())
    chosen = index[rim]
    return points[chosen], normals[chosen], float((hit & mask).sum() / mask.sum())


def _sample(image: Array, where: Array) -> Array:
    # The rim's pixel centres lie half a pixel inside the outline, so they are due at -0.5.
    return np.asarray(map_coordinates(image, where.T, order=1, mode="nearest") + 0.5)


def _jacobian(rim: Array, normal: Array, mesh: Mesh, camera: PinholeCamera) -> Array:
    # How far the outline moves outwards, in pixels, for an arc and a shift of 1 mm along each axis. A turn moves
    # the surface along its normal; a shift counts across the line of sight, since the outline is where the two
    # are perpendicular and the rim pixel's own normal still leans towards the camera.
    sight = unit(rim - camera.position_mm)
    across = unit(normal - sight * np.sum(normal * sight, axis=1, keepdims=True))
    pivot = np.asarray(mesh.translation_mm)
    scale = camera.focal_px / (camera.distance_mm - rim[:, 2])
    turn = np.cross(rim - pivot, normal) / _size(rim, pivot)
    return np.asarray(scale[:, None] * np.hstack([turn, across]))


def _size(points: Array, pivot: Array) -> float:
    return float(np.sqrt(np.mean(np.sum((points - pivot) ** 2, axis=1))))


def _moved(mesh: Mesh, move: Array, size_mm: float) -> Mesh:
    turn = Rotation.from_rotvec(move[:3] / size_mm) * Rotation.from_rotvec(np.deg2rad(mesh.rotation_deg))
    x, y, z = (float(v) for v in np.rad2deg(turn.as_rotvec()))
    a, b, c = (float(v) for v in np.asarray(mesh.translation_mm) + move[3:])
    return mesh.model_copy(update={"rotation_deg": (x, y, z), "translation_mm": (a, b, c)})
