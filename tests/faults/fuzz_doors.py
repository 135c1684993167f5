"""Hostile and damaged files at every door: how many were refused in words, and what was not.

Run: .venv/bin/python tests/faults/fuzz_doors.py [--door capture] [--seconds 3600 | --inputs 120] [--seed 1] [--jobs 2]
     [--keep DIR]

Each input is read in a process of its own kind, with 1 GiB of memory beside what the program itself has and 5 s of
processor time. One input in eight is a pipe, a device, a link or a circle of links in the place of the file. Counted
are: refused (an error of the user's, exit code 2, in lines of a bearable length), accepted (read to the end, and what
was read is looked at for nonsense), and what must not be: tracebacks, crashes, hangs, nonsense accepted, and obeyed,
where a command that the file names was run or a place that it names was written. The exit code is 1 if there is any;
--keep saves those inputs.
"""

import argparse
import multiprocessing
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from fuzz_mutators import TRAP, put_impostor
from fuzz_seeds import DOORS, fresh

MEMORY = 1 << 30
PROCESSOR_S = 5.0
#: A loaded machine lets a process wait; its own time is what counts, and this only ends the waiting.
WAIT_S = 60.0
LONGEST_LINE = 1000
BAD = ("traceback", "crash", "hang", "nonsense", "obeyed")
#: One input in so many is no file.
IMPOSTORS = 8


def _serve(door: str, pipe: Connection) -> None:
    """Read files as they are named, and tell what came of each."""
    from processing.errors import ProcessError

    # Libraries in C write their complaints there themselves.
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    while True:
        path = pipe.recv()
        start_s = time.process_time()
        try:
            nonsense = DOORS[door].read(path)
            outcome = ("nonsense", nonsense) if nonsense else ("accepted", "")
        except ProcessError as error:
            lines = str(error).splitlines()
            readable = lines and max(map(len, lines)) <= LONGEST_LINE and len(lines) <= 31
            outcome = ("refused", str(error)) if readable else ("traceback", f"unreadable: {str(error)[:300]!r}")
        except BaseException:  # noqa: BLE001 - whatever came is what is counted
            outcome = ("traceback", traceback.format_exc())
        spent_s = time.process_time() - start_s
        pipe.send(outcome if spent_s < PROCESSOR_S else ("hang", f"{spent_s:.1f} s: {outcome}"))


class Reader:
    """A process that reads files, started anew when one has ended it."""

    def __init__(self, door: str) -> None:
        self._door = door
        self._process: multiprocessing.process.BaseProcess | None = None

    def read(self, path: Path) -> tuple[str, str]:
        """What came of a file, and the words."""
        if self._process is None:
            self._pipe, child_end = multiprocessing.Pipe()
            # What is loaded here is loaded there.
            self._process = multiprocessing.get_context("fork").Process(
                target=_serve, args=(self._door, child_end), daemon=True
            )
            self._process.start()
            child_end.close()
        try:
            self._pipe.send(path)
            if self._pipe.poll(WAIT_S):
                return self._pipe.recv()
            self.close()
            return "hang", f"no answer in {WAIT_S:g} s"
        except (EOFError, OSError):
            self._process.join()
            code, self._process = self._process.exitcode, None
            return "crash", f"the process ended with {code}"

    def close(self) -> None:
        """End it."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None


def fuzz(name: str, seed: int, inputs: int | None, seconds: float | None, keep: Path | None) -> Counter[str]:
    """Spoil sound files and read them, for so many inputs or seconds; prints what must not be."""
    door, rng, outcomes = DOORS[name], random.Random(f"{seed} {name}"), Counter[str]()
    end_s = time.monotonic() + (seconds or 1e9)
    reader = Reader(name)
    with tempfile.TemporaryDirectory() as folder:
        sources = door.make(Path(folder))
        for source in sources:
            outcome, words = reader.read(source)
            if outcome != "accepted" and name != "tensor":
                raise SystemExit(f"{name}: the sound file {source.name} was not accepted: {words}")
        while outcomes.total() < (inputs or 1 << 60) and time.monotonic() < end_s:
            path = fresh(rng.choice(sources), Path(folder))
            if rng.randrange(IMPOSTORS) == 0:
                put_impostor(rng, path)
            else:
                door.spoil(rng, path)
            outcome, words = reader.read(path)
            if TRAP.exists():
                outcome, words = "obeyed", f"{TRAP} was made"
                TRAP.unlink()
            outcomes[outcome] += 1
            if outcome in BAD:
                print(f"{name} input {outcomes.total()}: {outcome}: {words}", flush=True)
                if keep is not None and path.is_file():
                    keep.mkdir(parents=True, exist_ok=True)
                    shutil.copy(path, keep / f"{name}_{seed}_{outcomes.total()}_{path.name}")
    reader.close()
    return outcomes


def main() -> int:
    """Fuzz and print one line a door."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--door", default="all", choices=["all", *DOORS])
    parser.add_argument("--seconds", type=float, help="for each door")
    parser.add_argument("--inputs", type=int, default=None, help="for each door; default 120 without --seconds")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="doors at a time")
    parser.add_argument("--keep", type=Path, help="folder for the inputs that must not be")
    options = parser.parse_args()
    inputs = options.inputs or (None if options.seconds else 120)
    total: Counter[str] = Counter()
    print(f"{'door':<11} {'inputs':>7} {'refused':>8} {'accepted':>9} " + " ".join(f"{outcome:>9}" for outcome in BAD))
    names = list(DOORS) if options.door == "all" else [options.door]
    fuzz_door = partial(fuzz, seed=options.seed, inputs=inputs, seconds=options.seconds, keep=options.keep)
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("fork")) as pool:
        for name, outcomes in zip(names, pool.map(fuzz_door, names), strict=True):
            total += outcomes
            _print(name, outcomes)
    _print("all", total)
    return int(any(total[outcome] for outcome in BAD))


def _print(name: str, outcomes: Counter[str]) -> None:
    bad = " ".join(f"{outcomes[outcome]:>9}" for outcome in BAD)
    print(f"{name:<11} {outcomes.total():>7} {outcomes['refused']:>8} {outcomes['accepted']:>9} {bad}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
