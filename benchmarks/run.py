"""Speed of the hot paths compared with other programs, measured in turns in one run; medians and ratios.

Run: ./lab bench [--repeats 7] [--peers PYTHON]
Absolute times drift between machines and with other work on them, so every round measures ours and then each peer;
the ratio is the median of the rounds' ratios. The peers live in an environment of their own, with
benchmarks/requirements.txt; it is made under ~/.cache/umov on first use. Without it only numpy and OpenCV are
compared, with a message. On a busy machine a target that the wall clock misses but the processor time of a core meets
is not judged.
"""

import argparse
import os
import platform
import tempfile
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import error_bar_tasks as error_bars
import image_tasks as image
import reduction_tasks as reduction
from measuring import LARGE, SMALL, Task, measure
from peer_process import PeerProcess, peer_python
from rich.console import Console

from processing.computing.threads import thread_count


def tasks(peers: PeerProcess | None, folder: Path) -> list[tuple[str, Callable[[], Task]]]:
    """Every row of the project's table of targets, in its order; a task is made when its turn comes."""
    small = folder / "small.h5"
    reduction.write_frames(small, SMALL)

    def large() -> Path:
        path = folder / "weighted.h5"
        reduction.write_frames(path, LARGE)
        return path

    return [
        ("drr small", lambda: image.drr(SMALL, 12, peers)),
        ("drr large", lambda: image.drr(LARGE, 110, peers)),
        ("field", lambda: reduction.varying_w(small, 60)),
        ("weighted small", lambda: reduction.weighted(small, 1000)),
        ("weighted large", lambda: reduction.weighted(large(), 12_000)),
        ("cloude small", lambda: image.dominant(SMALL, 12, peers)),
        ("cloude large", lambda: image.dominant(LARGE, 150, None)),
        ("eigenvalues", lambda: image.eigenvalues(LARGE, 2000)),
        ("lu-chipman", lambda: image.polar(SMALL, 20, peers)),
        ("error bars, xi0", error_bars.xi0),
        ("error bars, quantities", error_bars.all_quantities),
        ("error bars, table", lambda: error_bars.table(folder)),
        ("mosaic", lambda: image.mosaic(LARGE, 12, peers)),
        ("xi0", lambda: image.xi0(10)),
        ("table", lambda: image.table(60)),
        ("normals", lambda: image.normals(500, folder)),
        ("capture to disc", lambda: reduction.capture_to_disc(folder)),
        ("acquire", lambda: reduction.acquire(folder)),
        ("reduce", lambda: reduction.reduce_file(folder, 2500)),
        ("start-up", lambda: reduction.start_up(500)),
        ("diagnose unknown", lambda: reduction.diagnose(folder, 30_000, air=False)),
        ("diagnose moves", lambda: reduction.diagnose(folder, 30_000, air=False, moves=True)),
        ("diagnose air", lambda: reduction.diagnose(folder, 30_000, air=True)),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7, help="rounds of ours; slow peers run in two of them")
    parser.add_argument("--peers", type=Path, help="Python that has benchmarks/requirements.txt")
    parser.add_argument("--no-peers", action="store_true", help="ours and numpy alone")
    parser.add_argument("--only", help="run the tasks whose name contains this")
    options = parser.parse_args()
    console = Console(highlight=False, width=160)
    load = os.getloadavg()[0]
    console.print(
        f"{platform.machine()}, {thread_count()} threads, Python {platform.python_version()}, load {load:.1f}"
    )
    busy = load > 0.5 * thread_count()
    if busy:
        console.print("other programs are busy: trust the ratios, not the times", style="yellow")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        python = None if options.no_peers else peer_python(options.peers, console)
        peers = PeerProcess(python, folder) if python else None
        if peers:
            console.print("peers: " + ", ".join(f"{n} {v}" for n, v in peers.versions.items()))
        missed = []
        for label, make in tasks(peers, folder):
            if (options.only is None or options.only in label) and not measure(make(), options.repeats, console, busy):
                missed.append(label)
        if peers:
            peers.close()
        open_ = f"missed or not judged: {', '.join(missed)}"
        console.print(open_ if missed else "every target met", style="bold")


if __name__ == "__main__":
    main()
