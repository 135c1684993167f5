"""The paper in one command: simulate, acquire on emulators, process, and write one page with the paper's numbers.

    ./lab paper [--work DIR] [--out paper.html]

Jarecki and Kupinski, "Efficient Modeling of Depolarizing Mueller BRDFs": a red sphere at 15 arm angles and two
wavelengths, with a Mueller polarimeter and a linear Stokes camera, and a body at one angle; then an undeclared fault
of the bench. What was taken already in the work folder is not taken again. `--quick` does the same at one wavelength
and one angle on a small camera.
"""

import argparse
import os
import tempfile
import time
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path

# Before numpy: workers share the cores, threads of BLAS would fight for them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from paper_study.acquire import QUICK, SHOWN_DEG, Size, parts, take_captures
from paper_study.figures import deviations
from paper_study.page import write_page
from paper_study.process import study_body, study_fault, study_sphere

from processing.campaign.executors import executor


def run(work: Path, out: Path, size: Size, pool: Executor, *, figure: Path | None = None) -> None:
    """Take the missing captures, process them and write the page; products of an earlier run are used again.

    `figure`: file for the deviations against Omega.
    """
    seconds: dict[str, float] = {}
    begin = time.perf_counter()

    def say(text: str) -> None:
        print(f"{time.perf_counter() - begin:6.0f} s  {text}", flush=True)

    def take_part(number: int) -> Path:
        part_begin = time.perf_counter()
        part = parts(size)[number]
        say(f"acquire: {part.name}")
        folder = take_captures(work, size, part)
        seconds[f"captures of {part.name}"] = time.perf_counter() - part_begin
        return folder

    # One camera is emulated at a time; a finished part is processed while the next part is taken.
    with ThreadPoolExecutor(1) as bench:
        folders = [bench.submit(take_part, number) for number in range(3)]
        sphere = study_sphere(folders[0].result(), work / "results/sphere", pool, say)
        body = study_body(folders[1].result())
        fault = study_fault(folders[2].result(), work / "results/fault", sphere, pool, say=say)
    say("page")
    seconds["in all"] = time.perf_counter() - begin
    write_page(out, size, sphere, body, fault=fault, seconds=seconds)
    if figure is not None:
        deviations(sphere).figure.savefig(figure, dpi=80)
    say(str(out))


def main() -> None:
    """Entry point of `./lab paper`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, help="folder for captures and products; default: one that is deleted")
    parser.add_argument("--out", type=Path, default=Path("paper.html"), help="the page")
    parser.add_argument("--figure", type=Path, help="file for the figure of docs/paper-study.md (PNG)")
    parser.add_argument("--workers", type=int, default=2, help="processes that work on captures")
    angles = list(Size().omega_deg)
    parser.add_argument("--omega", type=float, nargs="+", default=angles, help="arm angles, 35 among them")
    parser.add_argument("--pixels", type=int, default=Size().pixels, help="rows and columns of the camera")
    parser.add_argument("--frames", type=int, default=Size().frames, help="of a Stokes capture")
    parser.add_argument("--quick", action="store_true", help="one wavelength, one angle, a small camera")
    options = parser.parse_args()
    if SHOWN_DEG not in options.omega:
        parser.error(f"--omega: the page shows images at {SHOWN_DEG:g} degrees, which must be among the angles")
    fault_deg = tuple(omega for omega in Size().fault_deg if omega in options.omega)
    size = Size(Size().wavelengths_nm, tuple(options.omega), fault_deg, options.pixels, options.frames)
    if options.quick:
        size = QUICK
    out = options.out.resolve()
    with tempfile.TemporaryDirectory() as temporary, executor(1 if options.quick else options.workers) as pool:
        run((options.work or Path(temporary)).resolve(), out, size, pool, figure=options.figure)


if __name__ == "__main__":
    main()
