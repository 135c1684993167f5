"""Tasks of `process reduce` and `diagnose` on captures: W of each pixel, weights, file to file, writing, start-up."""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from measuring import LARGE, SMALL, Program, Spent, Task, seconds

from acquisition.capture.writer import CaptureWriter, StateRecord
from drivers.motion import Position
from processing.computing.threads import for_ranges
from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.reduction.mueller import BLOCK_PIXELS
from processing.reduction.mueller_reduction import Choice, MuellerReduction
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import CaptureHeader, Detector, Sample
from simulators.blind.undeclared_captures import TrueBench, TrueScene, digitize, expose, state_angles, write_capture

ROOT = Path(__file__).resolve().parents[1]
INSTRUMENT = ROOT / "configs/instruments/rgb950.yaml"
#: A retardance map for each retarder, about 16 degrees from end to end; terms x, y, x^2, x y, y^2, degrees.
FIELD_DEG = {
    "psg_retarder": {"x": 4.0, "y": -2.0, "x2": 3.0, "xy": 1.0, "y2": 0.0},
    "psa_retarder": {"x": -1.0, "y": 5.0, "x2": 0.0, "xy": -2.0, "y2": 3.0},
}


def some_frames(shape: tuple[int, int], states: int) -> list[np.ndarray]:
    """A frame of random counts (1, rows, columns) for each state."""
    frame = np.random.default_rng(1).integers(800, 3000, (1, *shape), dtype=np.uint16)
    return [frame + np.uint16(n) for n in range(states)]


def frames_of_a_ball(shape: tuple[int, int], states: int) -> list[np.ndarray]:
    """As a camera takes them, each with its own shot noise: products of equal frames pack as none of a camera do."""
    random = np.random.default_rng(5)
    y, x = np.meshgrid(*(np.linspace(-1, 1, n, dtype=np.float32) for n in shape), indexing="ij")
    lit = np.sqrt(np.clip(0.8 - x**2 - y**2, 0, None))
    frames = []
    for n in range(states):
        light = 2700 * lit * (1 + np.sin(0.7 * n + 3 * x) * (0.2 + 0.3 * (x**2 + y**2))) / 1.5
        noise = np.sqrt(light / 2.6 + 1) * random.standard_normal(shape, dtype=np.float32)
        frames.append(np.round(light + noise + 50).clip(0, 4095).astype(np.uint16)[None])
    return frames


def write_frames(
    path: Path,
    shape: tuple[int, int],
    make_frames: Callable[[tuple[int, int], int], list[np.ndarray]] = some_frames,
    omega_deg: float | None = None,
) -> tuple[float, float]:
    """A capture of 40 states through the writer of `acquire`; seconds to create it and to fill it."""
    table = rotating_retarders(0.01)
    header = CaptureHeader(
        title="speed",
        simulated=True,
        mode="drr",
        wavelength_nm=662,
        omega_deg=omega_deg,
        sample=Sample(kind="unknown"),
        detector=Detector(black_level_counts=50, gain_e_per_count=2.6, read_noise_e=2.3, full_well_e=1e6, bits=16),
        instrument_yaml=INSTRUMENT.read_text(encoding="utf-8"),
    )
    frames = make_frames(shape, len(table))
    begin = time.perf_counter()
    writer = CaptureWriter.create(path, header, table, shape, start_time="2026-01-01T00:00:00+00:00")
    created = time.perf_counter()
    for n, pixels in enumerate(frames):
        pose = {axis: float(values[n]) for axis, values in table.angles_deg.items()}
        writer.put(StateRecord(n, pixels, {axis: Position(deg, deg) for axis, deg in pose.items()}))
    writer.seal("complete", {})
    return created - begin, time.perf_counter() - created


def open_capture(path: Path, choice: Choice, field_retardance: bool = False) -> tuple[Capture, MuellerReduction]:
    """What `process reduce` holds while it works on a capture, for tasks that measure its solvers alone."""
    capture, model = Capture(path), InstrumentModel.load(INSTRUMENT).at(662)
    if field_retardance:
        effects = []
        for element, terms in FIELD_DEG.items():
            values = {k: EffectParameter(value=v, unit="degree") for k, v in terms.items()}
            effects.append(
                AppliedEffect(kind="field_retardance", element=element, parameters=values, scope="instrument")
            )
        model = model.model_copy(update={"effects": tuple(effects)})
    return capture, MuellerReduction.of(capture, model, choice=choice)


def varying_w(path: Path, target_ms: float) -> Task:
    """uint16 frames to M, W of each pixel; peer: the pseudo-inverse of each pixel's W, built and applied."""
    capture, reduction = open_capture(path, Choice(), field_retardance=True)
    if (field := reduction.field) is None:
        raise SystemExit("the instrument has no retardance map")
    solver, (height, width) = reduction.solver(capture), capture.frame_shape
    frames = np.array(solver.reader.read(slice(0, height))[:, 0])
    out, few = np.empty((16, height * width), np.float32), 400

    def rows(start: int, stop: int) -> None:
        for row in range(start, stop, 3):
            last = min(row + 3, stop)
            pixels = slice(row * width, last * width)
            out[:, pixels] = solver.mueller(frames[:, pixels].astype(np.float32), row, last)

    def pixel_by_pixel() -> None:
        places = np.linspace(-1, 1, few)
        for k, extra in enumerate(field.extra(places, places).T):
            np.linalg.pinv(field.matrix(extra)) @ frames[:, k]

    name = f"40 x {height} x {width} uint16 to M, W of each pixel"
    task = Task(name, target_ms, lambda: for_ranges(height, rows, align=1, smallest=16))
    task.peers[f"numpy pinv of each pixel (scaled from {few})"] = lambda: seconds(pixel_by_pixel) * height * width / few
    return task


def weighted(path: Path, target_ms: float) -> Task:
    """Weighted fit with the 16 x 16 covariance of each pixel; peer: the same in numpy, batched."""
    capture, reduction = open_capture(path, Choice(weighted=True, covariance=True))
    solver, (height, width), few = reduction.solver(capture), capture.frame_shape, 4000
    rows = max(1, BLOCK_PIXELS // width)
    w, counts = reduction.w.reshape(-1, 16), np.random.default_rng(2).uniform(500, 3000, (few, 40))

    def ours() -> None:
        for first in range(0, height, rows):
            solver.solve(solver.reader.read(slice(first, min(first + rows, height))))

    def batched() -> None:
        normal = np.einsum("ni,pn,nj->pij", w, 1 / counts, w, optimize=True)
        np.einsum("pij,pj->pi", np.linalg.inv(normal), (counts / counts) @ w)

    name = f"40 x {height} x {width}, noise-weighted, 16 x 16 covariance of each pixel"
    task = Task(name, target_ms, ours, rounds=None if height * width < 1e6 else 2)
    task.peers[f"numpy inv, batched (scaled from {few})"] = lambda: seconds(batched) * height * width / few
    return task


def capture_to_disc(folder: Path) -> Task:
    """40 states of 2048 x 2448 through the writer of `acquire`; peers: the same bytes in one plain file."""

    def ours() -> Spent:
        path, begin = folder / "written.h5", time.process_time()
        created, filled = write_frames(path, LARGE)
        path.unlink()
        return Spent(created + filled, time.process_time() - begin)

    def raw(each_state: bool) -> float:
        """As many frames, of memory of their own as the writer's; synced at the end, or twice a state as the writer."""
        frames = some_frames(LARGE, 40)
        path, size, begin = folder / "raw", frames[0].nbytes, time.perf_counter()
        with path.open("wb", buffering=0) as file:
            os.posix_fallocate(file.fileno(), 0, len(frames) * (size + 1))
            for n, frame in enumerate(frames):
                os.pwrite(file.fileno(), frame.data, n * size)
                if each_state:
                    os.fdatasync(file.fileno())
                    os.pwrite(file.fileno(), b"1", len(frames) * size + n)
                    os.fdatasync(file.fileno())
            os.fsync(file.fileno())
        took = time.perf_counter() - begin
        path.unlink()
        return took

    task = Task("capture of 400 MB to disc, each state synced", None, ours, rounds=7)
    task.peers = {"raw write, one sync": lambda: raw(False), "raw write, each state synced": lambda: raw(True)}
    task.at_most = ("raw write, one sync", 1.3)
    return task


def reduce_file(folder: Path, target_ms: float) -> Task:
    """`process reduce` as a whole program, file to file, without a figure."""
    path = folder / "large.h5"
    write_frames(path, LARGE, frames_of_a_ball)
    argv = [sys.executable, "-m", "processing.commands.application", "reduce", path, "--out", folder / "large.m.h5"]
    program = Program([*argv, "--no-figure", "--overwrite"])
    task = Task("process reduce, 40 x 2048 x 2448, file to file", target_ms, program, rounds=5)
    task.also = lambda: [("peak memory", program.peak_mib, 1024, "MiB")]
    return task


def acquire(folder: Path) -> Task:
    """A capture on the simulated rig, its motors at their true speed; time of the states beyond the unavoidable."""
    out = folder / "acquired"
    program = Program([ROOT / "lab", "acquire", "--omega", "35", "--exposure", "0.1", "--out", out])

    def beyond() -> list[tuple[str, float, float, str]]:
        with Capture(sorted(out.glob("*.h5"))[-1]) as capture:
            return [("beyond moves, settling, exposure, readout", 100 * capture.closing["ledger"]["excess"], 5, "%")]

    return Task("acquire, 40 states, 0.1 s exposure, simulated rig", None, program, rounds=2, also=beyond)


def start_up(target_ms: float) -> Task:
    return Task("acquire --help", target_ms, Program([ROOT / "lab", "acquire", "--help"]), rounds=7)


def diagnose(folder: Path, target_ms: float, air: bool, moves: bool = False) -> Task:
    """All effects, all pixels of 40 states of 600 x 600, the analyzer's retarder 0.05 degrees off.

    `moves`: the image circles by 0.6 pixel with the generator's retarder, too.
    """
    bench, random = TrueBench(rows=SMALL[0], columns=SMALL[1], oa=np.deg2rad(13.41 + 0.05)), np.random.default_rng(1)
    if moves:
        bench.shift.append(lambda k, a: (0.6 * np.cos(a["psg"]), 0.6 * np.sin(a["psg"])))
    angles = state_angles(40, False, False)
    counts = digitize(bench, expose(bench, TrueScene(random, np.eye(4) if air else None), angles), random)
    sample = Sample(kind="air" if air else "unknown")
    path = folder / f"diagnose_{sample.kind}{'_moves' if moves else ''}.h5"
    write_capture(path, bench, counts, angles, sample=sample, instrument=INSTRUMENT.read_text(encoding="utf-8"))
    model = InstrumentModel.load(INSTRUMENT)
    name = f"diagnose, 40 x 600 x 600, all effects, all pixels, sample {sample.kind}{', image moves' if moves else ''}"
    return Task(name, target_ms, lambda: diagnose_captures([path], model), rounds=1)
