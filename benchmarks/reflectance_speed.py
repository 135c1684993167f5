"""xi0, tables and normals beside what users have now, in one run; medians and ratios.

Run: OPENBLAS_NUM_THREADS=1 .venv/bin/python benchmarks/reflectance_speed.py [--repeats 7]
Targets (performance.md): xi0 10 ms, table 60 ms, normals of a mesh 500 ms with a library. Compilation is not counted.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from processing.geometry.mesh import Mesh
from processing.geometry.pinhole import PinholeCamera
from processing.geometry.rusinkiewicz import Angles
from processing.table_axes import SHAPE
from processing.tables import ScatteringTable
from processing.xi0 import xi0_and_m00
from simulators.scene import Scene

ROWS, COLUMNS = 2048, 2448
ROOT = Path(__file__).resolve().parents[1]


def median_ms(work: Callable[[], object], repeats: int) -> float:
    """Median wall time in ms, first call left out."""
    work()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return 1000 * float(np.median(times))


def show(name: str, ours: float, peer: str, theirs: float) -> None:
    print(f"{name:<44} {ours:9.1f} ms   {peer}: {theirs:9.1f} ms   ratio {theirs / ours:6.1f}")


def xi0(repeats: int) -> None:
    rng = np.random.default_rng(0)
    intensities = rng.uniform(1000, 4000, (4, ROWS, COLUMNS)).astype(np.float32)
    model = rng.uniform(0.1, 0.4, (4, ROWS, COLUMNS)).astype(np.float32)
    first = np.full(4, 0.25)
    out = np.empty((ROWS, COLUMNS), np.float32), np.empty((ROWS, COLUMNS), np.float32)
    ours = median_ms(lambda: xi0_and_m00(intensities, model, first, out), repeats)
    few = 20_000

    def pinv() -> None:
        phi = np.stack([model.reshape(4, -1)[:, :few], np.full((4, few), 0.25)], axis=-1).transpose(1, 0, 2)
        np.einsum("nij,jn->ni", np.linalg.pinv(phi), intensities.reshape(4, -1)[:, :few])

    theirs = median_ms(pinv, 1) * ROWS * COLUMNS / few
    show("xi0 and M00 from 4 intensities, 5 Mpx", ours, "batched pinv (scaled up)", theirs)


def table(repeats: int) -> None:
    scene = Scene.load(ROOT / "configs/scenes/red_sphere.yaml")
    truth = scene.truth(35, 662, ROWS, COLUMNS)
    if truth.geometry is None:
        raise SystemExit("the scene shows no object")
    angles = truth.geometry.points.angles
    copies = -(-ROWS * COLUMNS // angles.theta_h.size)
    every = Angles(*(np.tile(a, copies)[: ROWS * COLUMNS] for a in angles))
    values = np.random.default_rng(1).random((16, ROWS * COLUMNS), dtype=np.float32)
    filled = ScatteringTable(tuple(f"m{k}" for k in range(16)), 662)
    ours = median_ms(lambda: filled.add(every, values), repeats)
    bins = filled.axes.bins(every)
    bins_ms = median_ms(lambda: filled.axes.bins(every), repeats)

    def bincount() -> None:
        for plane in values:
            np.bincount(bins, weights=plane, minlength=SHAPE[0] * SHAPE[1] * SHAPE[2])

    show("table, 16 elements, 5 Mpx, mean+variance", ours, "numpy bincount, sums alone", median_ms(bincount, 1))
    print(f"{'  of it the bins':<44} {bins_ms:9.1f} ms")


def normals(repeats: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ball.stl"
        trimesh.creation.icosphere(subdivisions=6, radius=12.7).export(path)
        camera = PinholeCamera(rows=ROWS, columns=COLUMNS, pixel_mm=0.00345, focal_length_mm=60, distance_mm=262.7)
        mesh = Mesh(file=str(path))
        rays = camera.rays()
        ours = median_ms(lambda: mesh.intersect(camera.position_mm, rays, 0.0), repeats)
        flat_mesh = mesh.model_copy(update={"smooth_normals": False})
        plain = median_ms(lambda: flat_mesh.intersect(camera.position_mm, rays, 0.0), repeats)
        loaded = trimesh.load_mesh(path)
        origins = np.broadcast_to(camera.position_mm, (rays.shape[0] * rays.shape[1], 3))

        def documented() -> None:
            _, _, triangle = loaded.ray.intersects_location(origins, rays.reshape(-1, 3), multiple_hits=False)
            loaded.face_normals[triangle]

        show("points and normals, 82 k triangles, 5 Mpx", plain, "trimesh as documented", median_ms(documented, 1))
        print(f"{'  with normals interpolated':<44} {ours:9.1f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    repeats = parser.parse_args().repeats
    xi0(repeats)
    table(repeats)
    normals(max(2, repeats // 3))


if __name__ == "__main__":
    main()
