"""The loop of meshes: where a ray meets its triangle, and the normal there."""

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.compiling import compiled, in_parts


@in_parts
def _meet_at_once(
    index: NDArray[np.intp],
    face: NDArray[np.intp],
    rays: Array,
    origin: Array,
    triangles: Array,
    face_normals: Array,
    corner_normals: Array,
    points: Array,
    normals: Array,
    part: slice,
) -> None:
    ray = rays[index[part]]
    f = face[index[part]]
    normal, corners = face_normals[f], triangles[f]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.einsum("ni,ni->n", corners[:, 0] - origin, normal) / np.einsum("ni,ni->n", ray, normal)
        points[part] = origin + t[:, None] * ray
        away = corners - points[part, None]
        area = np.cross(np.roll(away, -1, axis=1), np.roll(away, -2, axis=1))
        sums = np.einsum("nki,ni,nkj->nj", area, normal, corner_normals[f])
        normals[part] = sums / np.linalg.norm(sums, axis=1, keepdims=True)


@compiled(_meet_at_once, error_model="numpy")
def meet(index, face, rays, origin, triangles, face_normals, corner_normals, points, normals, start, stop):  # type: ignore[no-untyped-def]
    """Points and unit normals where rays[index[start:stop]] meet their triangles; writes `points` and `normals`.

    Not finite where a face has no area, or the normals of its corners cancel.
    """
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


@compiled(inline="always")
def _area(px, py, pz, qx, qy, qz, n0, n1, n2):  # type: ignore[no-untyped-def]
    return (py * qz - pz * qy) * n0 + (pz * qx - px * qz) * n1 + (px * qy - py * qx) * n2
