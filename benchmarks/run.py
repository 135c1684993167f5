"""Speed of the hot paths beside what users have now, measured in turns in one run; medians and ratios.

Run: ./lab bench [--repeats 7] [--peers PYTHON]
Absolute times drift between machines and with other work on them, so every round measures ours and then each peer;
the ratio is the median of the rounds' ratios. The peers live in an environment of their own, with
benchmarks/requirements.txt; it is made under ~/.cache/umov on first use. Without it only numpy and OpenCV are
compared, with a message. On a busy machine a target that the wall clock misses but the processor time of a core meets
is not judged.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from rich.console import Console

from processing import mueller
from processing.cloude import coherency_eigenvalues, xi0_and_dominant
from processing.decompositions.lu_chipman import lu_chipman
from processing.instrument import InstrumentModel
from processing.inversion import Inversion, mueller_planes
from processing.mosaic.fused import LinearStokes, bilinear_stokes
from processing.mosaic.layout import MosaicLayout
from processing.states import rotating_retarders
from processing.threads import thread_count

HERE = Path(__file__).resolve().parent
SMALL, LARGE = (600, 600), (2048, 2448)
#: Rounds of peers that take seconds.
SLOW_ROUNDS = 2


@dataclass
class Task:
    """One line of the table: ours, its target, and the peers by name; a peer that is scaled up names its pixels."""

    name: str
    target_ms: float
    ours: Callable[[], object]
    peers: dict[str, Callable[[], float]] = field(default_factory=dict)


def seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


class PeerProcess:
    """The peers' interpreter, one request at a time."""

    def __init__(self, python: Path, folder: Path) -> None:
        self._folder = folder
        self._process = subprocess.Popen(
            [str(python), str(HERE / "peers.py")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.versions: dict[str, str] = self._ask({"task": "versions"})["versions"]

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        if self._process.stdin is None or self._process.stdout is None:
            raise RuntimeError("the peers' process has no pipes")
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError("the peers' process ended")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def task(self, name: str, *arrays: np.ndarray, scale: float = 1.0) -> Callable[[], float]:
        """A function that runs the task once and returns its seconds times `scale`, or raises RuntimeError."""
        files = []
        for k, array in enumerate(arrays):
            file = self._folder / f"{name}_{k}.npy"
            np.save(file, array)
            files.append(str(file))

        def run() -> float:
            found = self._ask({"task": name, "data": files})
            if "error" in found:
                raise RuntimeError(found["error"])
            return scale * float(found["seconds"])

        return run

    def close(self) -> None:
        self._process.terminate()
        self._process.wait()


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


def measure(task: Task, rounds: int, console: Console, busy: bool) -> None:
    task.ours()  # compiles, and touches the memory
    own: list[float] = []
    cores: list[float] = []
    ratios: dict[str, list[float]] = {name: [] for name in task.peers}
    times: dict[str, list[float]] = {name: [] for name in task.peers}
    silent: dict[str, str] = {}
    for k in range(rounds):
        begin = time.process_time()
        own.append(seconds(task.ours))
        cores.append((time.process_time() - begin) / thread_count())
        for name, run in task.peers.items():
            if name in silent or (k >= SLOW_ROUNDS and times[name] and times[name][-1] > 1):
                continue
            try:
                times[name].append(run())
            except RuntimeError as error:
                silent[name] = str(error)
                continue
            ratios[name].append(times[name][-1] / own[-1])
    ours, best, core = (1000 * float(v) for v in (np.median(own), min(own), np.median(cores)))
    if ours <= task.target_ms:
        verdict = "met"
    else:
        verdict = "not judged, other programs are busy" if busy and core <= task.target_ms else "MISSED"
    console.print(
        f"{task.name}: {ours:.1f} ms (best {best:.1f}, processor time of a core {core:.1f}), "
        f"target {task.target_ms:g} ms: {verdict}",
        style="bold",
    )
    for name in task.peers:
        if name in silent:
            console.print(f"    {name:<36} did not run: {silent[name][:80]}")
        else:
            median, ratio = 1000 * np.median(times[name]), np.median(ratios[name])
            console.print(f"    {name:<36} {median:10.1f} ms   {ratio:8.1f} x ours")


def peer_python(given: Path | None, console: Console) -> Path | None:
    """The peers' interpreter; makes their environment where none is given."""
    if given is not None:
        return given
    folder = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "umov/peers"
    python = folder / "bin/python"
    if not (folder / "complete").exists():
        console.print(f"making an environment for the peers in {folder} (once, about a minute)")
        venv.create(folder, with_pip=True, clear=True)
        wanted = HERE / "requirements.txt"
        done = subprocess.run([str(python), "-m", "pip", "install", "-q", "-r", str(wanted)], check=False)
        if done.returncode:
            console.print("the peers could not be installed: comparing with numpy and OpenCV alone", style="yellow")
            return None
        (folder / "complete").touch()
    return python


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7, help="rounds of ours; slow peers run in two of them")
    parser.add_argument("--peers", type=Path, help="Python that has benchmarks/requirements.txt")
    parser.add_argument("--only", help="run the tasks whose name contains this")
    options = parser.parse_args()
    console = Console(highlight=False, width=140)
    load = os.getloadavg()[0]
    console.print(
        f"{platform.machine()}, {thread_count()} threads, Python {platform.python_version()}, load {load:.1f}"
    )
    busy = load > 0.5 * thread_count()
    if busy:
        console.print("other programs are busy: trust the ratios, not the times", style="yellow")
    with tempfile.TemporaryDirectory() as folder:
        python = peer_python(options.peers, console)
        peers = PeerProcess(python, Path(folder)) if python else None
        if peers:
            console.print("peers: " + ", ".join(f"{n} {v}" for n, v in peers.versions.items()))
        tasks: list[tuple[str, Callable[[], Task]]] = [
            ("drr small", lambda: drr(SMALL, 12, peers)),
            ("drr large", lambda: drr(LARGE, 110, peers)),
            ("cloude small", lambda: dominant(SMALL, 12, peers)),
            ("cloude large", lambda: dominant(LARGE, 150, None)),
            ("eigenvalues", lambda: eigenvalues(LARGE, 2000)),
            ("lu-chipman", lambda: polar(SMALL, 20, peers)),
            ("mosaic", lambda: mosaic(LARGE, 12, peers)),
        ]
        for name, make in tasks:
            if options.only is None or options.only in name:
                measure(make(), options.repeats, console, busy)
        if peers:
            peers.close()
    if options.only is None:
        sys.stdout.flush()
        subprocess.run(
            [sys.executable, str(HERE / "reflectance_speed.py"), "--repeats", str(options.repeats)], check=True
        )


if __name__ == "__main__":
    main()
