"""Tasks on Mueller and mosaic images: inversion, eigenvalues, Lu-Chipman, demosaicing."""

from pathlib import Path

import cv2
import numpy as np
from measuring import Task, seconds
from peer_process import PeerProcess

from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.polarization import mueller
from processing.polarization.cloude import coherency_eigenvalues, xi0_and_dominant
from processing.polarization.decompositions.lu_chipman import lu_chipman
from processing.reduction.mosaic.fused import LinearStokes, bilinear_stokes
from processing.reduction.mosaic.layout import MosaicLayout
from processing.reduction.solvers.inversion import Inversion, mueller_planes

HERE = Path(__file__).resolve().parent


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
    model = InstrumentModel.load(HERE.parent / "configs/instruments/rgb950.yaml").at(662)
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
    task = Task(
        f"mosaic {shape[0]} x {shape[1]} to S, DoLP, AoLP",
        target_ms,
        lambda: bilinear_stokes(frame, layout, solve, out),
    )

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
