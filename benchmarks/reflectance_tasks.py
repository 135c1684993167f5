"""Tasks on reflectance: xi0 from intensities, tables over scattering geometry, normals of a mesh."""

from pathlib import Path

import numpy as np
import trimesh
from measuring import LARGE, Task, seconds

from processing.geometry.mesh import Mesh
from processing.geometry.pinhole import PinholeCamera
from processing.geometry.rusinkiewicz import Angles
from processing.polarization.xi0 import xi0_and_m00
from processing.reflectance.table_axes import SHAPE
from processing.reflectance.tables import ScatteringTable
from simulators.bench.scene import Scene

ROOT = Path(__file__).resolve().parents[1]
ROWS, COLUMNS = LARGE


def xi0(target_ms: float) -> Task:
    rng = np.random.default_rng(0)
    intensities = rng.uniform(1000, 4000, (4, ROWS, COLUMNS)).astype(np.float32)
    model = rng.uniform(0.1, 0.4, (4, ROWS, COLUMNS)).astype(np.float32)
    first = np.full(4, 0.25)
    out = np.empty((ROWS, COLUMNS), np.float32), np.empty((ROWS, COLUMNS), np.float32)
    few = 20_000

    def pinv() -> None:
        phi = np.stack([model.reshape(4, -1)[:, :few], np.full((4, few), 0.25)], axis=-1).transpose(1, 0, 2)
        np.einsum("nij,jn->ni", np.linalg.pinv(phi), intensities.reshape(4, -1)[:, :few])

    task = Task("xi0 and M00 from 4 intensities, 5 Mpx", target_ms, lambda: xi0_and_m00(intensities, model, first, out))
    task.peers[f"numpy pinv (scaled from {few})"] = lambda: seconds(pinv) * ROWS * COLUMNS / few
    return task


def table(target_ms: float) -> Task:
    """Mean and variance of 16 elements in bins that neighbouring pixels share, as in an image of a sphere."""
    truth = Scene.load(ROOT / "configs/scenes/red_sphere.yaml").truth(35, 662, ROWS, COLUMNS)
    if truth.geometry is None:
        raise SystemExit("the scene shows no object")
    angles = truth.geometry.points.angles
    copies = -(-ROWS * COLUMNS // angles.theta_h.size)
    every = Angles(*(np.tile(a, copies)[: ROWS * COLUMNS] for a in angles))
    values = np.random.default_rng(1).random((16, ROWS * COLUMNS), dtype=np.float32)
    filled = ScatteringTable(tuple(f"m{k}" for k in range(16)), 662)
    bins = filled.axes.bins(every)

    def bincount() -> None:
        for plane in values:
            np.bincount(bins, weights=plane, minlength=SHAPE[0] * SHAPE[1] * SHAPE[2])

    name = "table 91 x 91 x 361 x 16, mean and variance, 5 Mpx"
    task = Task(name, target_ms, lambda: filled.add(every, values))
    task.peers["numpy bincount, sums alone, bins given"] = lambda: seconds(bincount)
    return task


def normals(target_ms: float, folder: Path) -> Task:
    """Points and interpolated normals of a generated ball of 82 k triangles; with a library (embreex)."""
    path = folder / "ball.stl"
    trimesh.creation.icosphere(subdivisions=6, radius=12.7).export(path)
    camera = PinholeCamera(rows=ROWS, columns=COLUMNS, pixel_mm=0.00345, focal_length_mm=60, distance_mm=262.7)
    mesh, loaded = Mesh(file=str(path)), trimesh.load_mesh(path)
    rays = camera.rays()
    origins = np.broadcast_to(camera.position_mm, (ROWS * COLUMNS, 3))

    def documented() -> None:
        _, _, triangle = loaded.ray.intersects_location(origins, rays.reshape(-1, 3), multiple_hits=False)
        loaded.face_normals[triangle]

    name = "points and normals, 82 k triangles, 5 Mpx"
    task = Task(name, target_ms, lambda: mesh.intersect(camera.position_mm, rays, 0.0))
    task.peers["trimesh + embreex as documented, flat"] = lambda: seconds(documented)
    return task
