"""What reading compressed files costs where it is felt: each use of a capture and of its products, against plain ones.

    python benchmarks/packed_uses.py CAPTURE.h5 [--folder FOLDER --cold --only WORD]

The capture is copied plain and compressed (`acquire compress`), its product of quantities is made plain
(`UMOV_COMPRESS=0`) and as `process` writes it. Whole commands first, as they are typed, then single steps; by the clock
and of the processor, medians of the repeats, turn by turn. Files lie in memory, where compression gains nothing, or in
a folder of a disc; `--cold` has the system forget their contents before each use. `--only` measures the uses whose
names have the word. `view` is asked as a page asks, over
HTTP, and another place at each turn.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import xarray as xr
from view_times import Server

from processing import open_dataset, reduce_to_dataset
from processing.storage.packed_capture import pack_capture

REPEATS = 7
KINDS = ("plain", "packed")


#: Seconds by the clock and of the processor.
Times = tuple[float, float]


def process(*words: object, compress: bool = True) -> Times:
    """Run a command of `process`."""
    start_s, before = time.perf_counter(), os.times()
    subprocess.run(
        [sys.executable, "-m", "processing.commands.application", *map(str, words)],
        env=os.environ | ({} if compress else {"UMOV_COMPRESS": "0"}),
        stdout=subprocess.DEVNULL,
        check=True,
    )
    after = os.times()
    used_s = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - start_s, used_s


def timed(work: Callable[[], object]) -> Times:
    """How long something takes in this process."""
    start_s, before_s = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - start_s, time.process_time() - before_s


def load(path: Path) -> None:
    """All of a file's default group, by xarray and h5netcdf."""
    with xr.open_dataset(path, engine="h5netcdf", group="entry/data") as file:
        file.load()


def forget(path: Path) -> None:
    """Have the system forget what it keeps of a file in memory."""
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
        os.posix_fadvise(file, 0, 0, os.POSIX_FADV_DONTNEED)
    finally:
        os.close(file)


class Comparison:
    """Times uses of plain and packed files, turn by turn, and prints a line for each."""

    def __init__(self, cold: bool, only: str) -> None:
        self.cold, self.only = cold, only
        print(f"{'':<46} {'by the clock':^26}  {'of the processor':^26}")
        print(f"{'ms':<46}" + 2 * f" {'plain':>8} {'packed':>8} {'ratio':>8} ")

    def of(self, use: str, files: dict[str, Path], work: Callable[[Path, int], Times], repeats: int = REPEATS) -> None:
        """One use of either kind of file; once before, for what is kept or compiled."""
        if self.only not in use:
            return
        times: dict[str, list[Times]] = {kind: [] for kind in KINDS}
        for turn in range(repeats + 1):
            for kind in KINDS:
                if self.cold:
                    forget(files[kind])
                times[kind].append(work(files[kind], turn))
        line = f"{use:<46}"
        for clock in (0, 1):
            plain, packed = (1e3 * statistics.median(one[clock] for one in times[kind][1:]) for kind in KINDS)
            line += f" {plain:8.1f} {packed:8.1f} {packed / plain:8.2f} "
        print(line, flush=True)


def serve(folder: Path) -> tuple[subprocess.Popen[str], Server]:
    """`view` of a folder, as a process."""
    command = [sys.executable, "-m", "viewer.command", str(folder)]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert running.stdout is not None
    found = re.search(r"http\S+", running.stdout.readline())
    assert found is not None
    return running, Server(found[0].rstrip("/"), running.pid)


def measure(folder: Path, captures: dict[str, Path], products: dict[str, Path], cold: bool, only: str) -> None:
    """Every use in turn."""
    compare = Comparison(cold, only).of
    out = folder / "out"
    compare(
        "process reduce", captures, lambda path, _: process("reduce", path, "--overwrite", "--out", out / "image.h5"), 3
    )
    compare(
        "process report of the quantities",
        products,
        lambda path, _: process("report", path, "--overwrite", "--out", out / "r.html"),
        3,
    )
    compare(
        "reduction alone, without start and figure", captures, lambda path, _: timed(lambda: reduce_to_dataset(path))
    )
    compare("all frames, by xarray", captures, lambda path, _: timed(lambda: load(path)))
    compare("all planes of the quantities, by xarray", products, lambda path, _: timed(lambda: load(path)))
    compare("all frames, by processing.open_dataset", captures, lambda path, _: timed(lambda: open_dataset(path)))
    compare("all planes, by processing.open_dataset", products, lambda path, _: timed(lambda: open_dataset(path)))
    with h5py.File(captures["plain"]) as h5:
        rows, columns = h5["entry/instrument/detector/data"].shape[-2:]
    running, server = serve(folder)
    # The clock of another process counts in steps of 10 ms; a file that is forgotten is so for one question.
    questions = 1 if cold else 10
    try:

        def ask(address: str) -> Callable[[Path, int], Times]:
            def once(path: Path, turn: int) -> Times:
                start_s, before_s = time.perf_counter(), server.used_s()
                for again in range(questions):
                    x, y = 97 * turn % columns, (131 * turn + 37 * again) % rows
                    server.asked(address.format(file=path.name, state=turn + 4, x=x, y=y))
                return (time.perf_counter() - start_s) / questions, (server.used_s() - before_s) / questions

            return once

        compare("view: a page of a capture", captures, ask("capture?file={file}"))
        compare("view: a frame", captures, ask("frame?file={file}&state={state}&most=700"))
        compare(
            "view: a plane of the quantities",
            products,
            ask("plane?file={file}&name=depolarization_index&most=700"),
        )
        compare("view: a pixel's curve", captures, ask("curve?file={file}&x0={x}&y0={y}"))
        compare("view: a pixel's values of the quantities", products, ask("probe?file={file}&x0={x}&y0={y}"))
    finally:
        running.terminate()
        running.wait()


def main() -> None:
    """Make both kinds of each file, and measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--folder", type=Path, default=Path("/dev/shm"))
    parser.add_argument("--cold", action="store_true")
    parser.add_argument("--only", default="", metavar="WORD")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        folder = Path(name)
        (folder / "out").mkdir()
        captures = {kind: folder / f"{kind}.h5" for kind in KINDS}
        for path in captures.values():
            shutil.copy(options.capture, path)
        pack_capture(captures["packed"])
        products = {kind: folder / f"{kind}.quantities.h5" for kind in KINDS}
        process("reduce", captures["plain"], "--out", folder / "image.h5")
        for kind, path in products.items():
            process("quantities", folder / "image.h5", "--out", path, compress=kind == "packed")
        for what, files in (("capture", captures), ("quantities", products)):
            sizes = [path.stat().st_size / 1e6 for path in files.values()]
            print(f"{what}: {sizes[0]:.1f} MB plain, {sizes[1]:.1f} MB compressed")
        measure(folder, captures, products, options.cold, options.only)


if __name__ == "__main__":
    main()
