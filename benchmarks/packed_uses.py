"""What reading compressed files costs where it is felt: each use of a capture and of its products, against plain ones.

    python benchmarks/packed_uses.py CAPTURE.h5

The capture is copied plain and compressed (`acquire compress`), its product of quantities is made plain
(`UMOV_COMPRESS=0`) and as `process` writes it. Processor time of a use, median of the repeats, turn by turn; files in
memory, where compression gains nothing. `view` is asked as a page asks, over HTTP, and another place at each turn.
"""

from __future__ import annotations

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

from processing import reduce_to_dataset
from processing.storage.packed_capture import pack_capture

REPEATS = 7
KINDS = ("plain", "packed")


def process(*words: object, compress: bool = True) -> None:
    """Run a command of `process`."""
    subprocess.run(
        [sys.executable, "-m", "processing.commands.application", *map(str, words)],
        env=os.environ | ({} if compress else {"UMOV_COMPRESS": "0"}),
        stdout=subprocess.DEVNULL,
        check=True,
    )


def reduce(path: Path) -> float:
    """The work of `process reduce`, in this process; seconds of processor time."""
    start_s = time.process_time()
    reduce_to_dataset(path)
    return time.process_time() - start_s


def load(path: Path) -> float:
    """All of a file's default group, by xarray and h5netcdf; seconds of processor time."""
    start_s = time.process_time()
    with xr.open_dataset(path, engine="h5netcdf", group="entry/data") as file:
        file.load()
    return time.process_time() - start_s


def told(use: str, times: dict[str, list[float]]) -> None:
    """One line: milliseconds plain and packed, and their ratio."""
    plain, packed = (1e3 * statistics.median(times[kind]) for kind in KINDS)
    print(f"{use:<58} {plain:7.1f} ms {packed:7.1f} ms {packed / plain:6.2f}", flush=True)


def compare(use: str, work: Callable[[str, int], float], repeats: int = REPEATS) -> None:
    """Time a use of either kind, turn by turn; once before, for what is kept or compiled."""
    times: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for turn in range(repeats + 1):
        for kind in KINDS:
            times[kind].append(work(kind, turn))
    told(use, {kind: of[1:] for kind, of in times.items()})


def serve(folder: Path) -> tuple[subprocess.Popen[str], Server]:
    """`view` of a folder, as a process."""
    command = [sys.executable, "-m", "viewer.command", str(folder)]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert running.stdout is not None
    found = re.search(r"http\S+", running.stdout.readline())
    assert found is not None
    return running, Server(found[0].rstrip("/"), running.pid)


def measure(folder: Path, captures: dict[str, Path], products: dict[str, Path]) -> None:
    """Every use in turn."""
    compare("reduction to a Mueller image", lambda kind, _: reduce(captures[kind]), 3)
    compare("all frames, by xarray", lambda kind, _: load(captures[kind]))
    compare("all planes of the quantities, by xarray", lambda kind, _: load(products[kind]))
    with h5py.File(captures["plain"]) as h5:
        rows, columns = h5["entry/instrument/detector/data"].shape[-2:]
    running, server = serve(folder)
    try:

        def ask(address: str, files: dict[str, Path]) -> Callable[[str, int], float]:
            def once(kind: str, turn: int) -> float:
                place = {"state": turn + 4, "x": 97 * turn % columns, "y": 131 * turn % rows}
                # The clock of a process counts in steps of 10 ms.
                before_s = server.used_s()
                for again in range(10):
                    here = place | {"y": (place["y"] + 37 * again) % rows}
                    server.asked(address.format(file=files[kind].name, **here))
                return (server.used_s() - before_s) / 10

            return once

        compare("view: a frame", ask("frame?file={file}&state={state}&most=700", captures))
        compare("view: a pixel's curve, another place each time", ask("curve?file={file}&x0={x}&y0={y}", captures))
        compare("view: a pixel's values of the quantities", ask("probe?file={file}&x0={x}&y0={y}", products))
    finally:
        running.terminate()
        running.wait()


def main() -> None:
    """Make both kinds of each file, and measure."""
    with tempfile.TemporaryDirectory(dir="/dev/shm") as name:
        folder = Path(name)
        captures = {kind: folder / f"{kind}.h5" for kind in KINDS}
        for path in captures.values():
            shutil.copy(sys.argv[1], path)
        pack_capture(captures["packed"])
        products = {kind: folder / f"{kind}.quantities.h5" for kind in KINDS}
        process("reduce", captures["plain"], "--out", folder / "image.h5")
        for kind, path in products.items():
            process("quantities", folder / "image.h5", "--out", path, compress=kind == "packed")
        for what, files in (("capture", captures), ("quantities", products)):
            sizes = [path.stat().st_size / 1e6 for path in files.values()]
            print(f"{what}: {sizes[0]:.1f} MB plain, {sizes[1]:.1f} MB compressed")
        print(f"{'processor time':<58} {'plain':>10} {'packed':>10}  ratio")
        measure(folder, captures, products)


if __name__ == "__main__":
    main()
