"""Tasks on images: inversion, eigenvalues, Lu-Chipman, demosaicing, xi0, tables over scattering geometry, a mesh."""

from pathlib import Path

import cv2
import numpy as np
import trimesh
from measuring import LARGE, Task, seconds
from peer_process import PeerProcess

from processing.geometry.mesh import Mesh
from processing.geometry.pinhole import PinholeCamera
from processing.geometry.rusinkiewicz import Angles
from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.polarization import mueller
from processing.polarization.cloude import coherency_eigenvalues, xi0_and_dominant
from processing.polarization.decompositions.lu_chipman import lu_chipman
from processing.polarization.xi0 import xi0_and_m00
from processing.reduction.mosaic.fused import LinearStokes, bilinear_stokes
from processing.reduction.mosaic.layout import MosaicLayout
from processing.reduction.solvers.inversion import Inversion, mueller_planes
from processing.reflectance.table_axes import SHAPE
from processing.reflectance.tables import ScatteringTable
from simulators.bench.scene import Scene

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
ROWS, COLUMNS = LARGE


def random_mueller(pixels: int) -> np.ndarray:
    """Physical matrices (pixels, 4, 4), from nearly pure to strongly depolarizing; 20 000 different ones."""
    rng = np.random.default_rng(3)
    jones = rng.normal(size=(20_000, 4, 2, 2)) + 1j * rng.normal(size=(20_000, 4, 2, 2))
    m = (mueller.from_jones(jones) * rng.exponential(size=(20_000, 4, 1, 1)) ** 3).sum(axis=1)
    return np.resize(m, (pixels, 4, 4))


def planar(m: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The same as a float32 image (rows, columns, 4, 4) in planes, as products hold it."""
    image = np.ascontiguousarray(m.reshape(-1, 16).T, dtype=np.float32).reshape(4, 4, *shape)
    return np.moveaxis(image, (0, 1), (-2, -1))


def drr(shape: tuple[int, int], target_ms: float, peers: PeerProcess | None) -> Task:
    model = InstrumentModel.load(CONFIGS / "instruments/rgb950.yaml").at(662)
    angles = rotating_retarders(0.01).angles_deg
    inversion = Inversion.of(model.rows(angles).reshape(-1, 16))
    frames = np.random.default_rng(1).integers(100, 60_000, (40, *shape), dtype=np.uint16)
    flat, out = frames.reshape(40, -1), np.empty((16, frames[0].size), np.float32)
    pinv = inversion.pinv.astype(np.float32)
    task = Task(f"40 x {shape[0]} x {shape[1]} uint16 to M", target_ms, lambda: mueller_planes(inversion, flat, out))
    task.peers["numpy, float32 product"] = lambda: seconds(lambda: pinv @ flat.astype(np.float32))
    task.peers["OpenCV gemm"] = lambda: seconds(lambda: cv2.gemm(pinv, flat.astype(np.float32), 1, None, 0))
    if peers:
        g, a = model.generator_states(angles), model.analyzer_states(angles)[:, 0]
        task.peers["polanalyser"] = peers.task("polanalyser_mueller", frames, g, a)
    return task


def dominant(shape: tuple[int, int], target_ms: float, peers: PeerProcess | None) -> Task:
    pixels = shape[0] * shape[1]
    m = random_mueller(pixels)
    image, few = planar(m, shape), m[:36_000]
    out = xi0_and_dominant(image)
    task = Task(f"xi0 and m0, {shape[0]} x {shape[1]}", target_ms, lambda: xi0_and_dominant(image, out))
    task.peers["numpy eigh (scaled from 36 000)"] = lambda: seconds(
        lambda: np.linalg.eigh(mueller.coherency(few))
    ) * pixels / len(few)  # fmt: skip
    if peers:
        task.peers["py_pol covariance + eigh (scaled)"] = peers.task(
            "py_pol_eigenvalues", few[:9_000], scale=pixels / 9_000
        )
    return task


def eigenvalues(shape: tuple[int, int], target_ms: float) -> Task:
    image = planar(random_mueller(shape[0] * shape[1]), shape)
    few = np.ascontiguousarray(image.reshape(-1, 4, 4)[:36_000], dtype=float)

    def both() -> None:
        coherency_eigenvalues(image)
        xi0_and_dominant(image)

    task = Task(f"four eigenvalues and m0, {shape[0]} x {shape[1]}", target_ms, both)
    scale = shape[0] * shape[1] / len(few)
    task.peers["numpy eigh (scaled from 36 000)"] = lambda: (
        scale * seconds(lambda: np.linalg.eigh(mueller.coherency(few)))
    )
    return task


def polar(shape: tuple[int, int], target_ms: float, peers: PeerProcess | None) -> Task:
    pixels = shape[0] * shape[1]
    m = random_mueller(pixels)
    image = planar(m, shape)
    task = Task(f"Lu-Chipman, {shape[0]} x {shape[1]}", target_ms, lambda: lu_chipman(image))
    if peers:
        task.peers["muellerkit"] = peers.task("muellerkit_lu_chipman", m)
        for name, count in (("katsu", 36_000), ("py_pol", 9_000), ("pymueller", 3_600)):
            run = peers.task(f"{name}_lu_chipman", m[:count], scale=pixels / count)
            task.peers[f"{name} (scaled from {count})"] = run
    return task


def mosaic(shape: tuple[int, int], target_ms: float, peers: PeerProcess | None) -> Task:
    layout = MosaicLayout.of((("90", "45"), ("135", "0")), ("0", "45", "90", "135"))
    solve = np.array([[0.5, 0.5, 0.5, 0.5], [1, 0, -1, 0], [0, 1, 0, -1]])
    frame = np.random.default_rng(2).integers(100, 4000, shape, dtype=np.uint16)
    out = LinearStokes(*(np.empty(shape, np.float32) for _ in range(5)))
    name = f"mosaic {shape[0]} x {shape[1]} to S, DoLP, AoLP"
    task = Task(name, target_ms, lambda: bilinear_stokes(frame, layout, solve, out))

    def opencv() -> None:
        # The channels sit where a Bayer pattern has its colours, so OpenCV's bilinear Bayer code fills them.
        first = cv2.cvtColor(frame, cv2.COLOR_BayerBG2BGR)
        second = cv2.cvtColor(frame, cv2.COLOR_BayerGR2BGR)
        i90, i0, i45, i135 = (
            c.astype(np.float32) for c in (first[..., 0], first[..., 2], second[..., 0], second[..., 2])
        )
        s0, s1, s2 = (i0 + i45 + i90 + i135) / 2, i0 - i90, i45 - i135
        magnitude, _ = cv2.cartToPolar(s1, s2)
        cv2.divide(magnitude, s0)

    task.peers["OpenCV chain"] = lambda: seconds(opencv)
    if peers:
        task.peers["polanalyser"] = peers.task("polanalyser_mosaic", frame)
    return task


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
    truth = Scene.load(CONFIGS / "scenes/red_sphere.yaml").truth(35, 662, ROWS, COLUMNS)
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
