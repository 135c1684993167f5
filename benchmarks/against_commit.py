"""Speed of the commands and of the tasks of `./lab bench` beside an earlier commit of this project, in turns.

Run: python benchmarks/against_commit.py COMMIT [--rounds 5] [--only WORD] [--folder FOLDER]
The commit is checked out into a folder of its own and takes captures on its simulated rig, which both versions then
work on. A round runs each of them once, as a program of its own, in alternating order; the ratio is the median of
the rounds' ratios, by the processor's user time and by the clock. Other work on the machine disturbs the clock; it
disturbs both versions alike. The first round, which compiles, does not count.
"""

from __future__ import annotations

import argparse
import itertools
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
#: Honest error bars may take this much longer.
AT_MOST = 1.3
#: `{drr}` and `{stokes}` are captures, `{m}` and `{s}` products of them, `{out}` a new file.
COMMANDS = {
    "process reduce": "reduce {drr} --out {out}.h5 --no-figure",
    "process reduce, 2048 x 2448": "reduce {large} --out {out}.h5 --no-figure",
    "process reduce --weighted --covariance": "reduce {drr} --weighted --covariance --out {out}.h5 --no-figure",
    "process reduce, mosaic": "reduce {stokes} --out {out}.h5 --no-figure",
    "process xi0": "xi0 {m} --out {out}.h5 --no-figure",
    "process xi0, mosaic": "xi0 {s} --geometry {geometry} --material {material} --out {out}.h5 --no-figure",
    "process quantities": "quantities {m} --out {out}.h5 --no-figure",
    "process table": "table {m} --geometry {geometry} --out {out}.h5",
    "process fit-material": "fit-material {m} --geometry {geometry} --out {out}.yaml",
    "process design": "design {instrument} --wavelength 662",
    "process design --optimize ratio": "design {instrument} --wavelength 662 --optimize ratio",
    "process calibrate": "calibrate {air} --instrument {instrument} --free {free}",
}
#: Of `./lab bench`, what both versions have: the words of --only, and how the line begins where others fit too.
SAME_NAME = (
    *("drr", "field", "weighted small", "weighted large", "cloude", "eigenvalues", "lu-chipman", "mosaic", "normals"),
    *("capture to disc", "diagnose unknown", "diagnose moves", "diagnose air"),
)
TASKS = dict.fromkeys(SAME_NAME, "") | {"xi0": "xi0 and M00", "table": "table"}
FREE = "psg_retarder.retardance_deg,psg_retarder.azimuth_deg,psa_retarder.retardance_deg,psa_retarder.azimuth_deg"


@dataclass(frozen=True)
class Version:
    """A checked-out commit, run with this interpreter."""

    root: Path

    def run(self, code: list[str]) -> tuple[float, float, str]:
        """User seconds, seconds by the clock and output of a Python program of this version."""
        environment = os.environ | {"PYTHONPATH": str(self.root), "OPENBLAS_NUM_THREADS": "1"}
        before, begin = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime, time.perf_counter()
        done = subprocess.run(
            [sys.executable, *code], cwd=self.root, env=environment, capture_output=True, text=True, check=False
        )
        clock = time.perf_counter() - begin
        if done.returncode:
            raise SystemExit(f"{self.root.name}: {' '.join(code)}\n{done.stderr[-2000:]}")
        return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before, clock, done.stdout

    def script(self, name: str, *words: str) -> list[str]:
        """The command of an installed script, `process` or `acquire`, of this version."""
        scripts = tomllib.loads((self.root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
        module, _, function = scripts[name].partition(":")
        return ["-c", f"from {module} import {function}; {function}()", *words]


def both_in_turns(
    label: str, rounds: int, once: Callable[[Version], tuple[float, float]], old: Version, new: Version
) -> None:
    """Print one line: seconds of both versions and how many times as long the new one takes."""
    spent = {old: [], new: []}  # type: dict[Version, list[tuple[float, float]]]
    for version in (old, new):
        once(version)
    for k in range(rounds):
        for version in (old, new) if k % 2 else (new, old):
            spent[version].append(once(version))
    was, now = np.array(spent[old]), np.array(spent[new])
    user, clock = np.median(now / was, axis=0)
    verdict = "" if user <= AT_MOST else "   MORE THAN 1.3"
    times = f"user {np.median(was[:, 0]):7.3f} -> {np.median(now[:, 0]):7.3f} s"
    print(f"{label:40s} {times}   ratio: user {user:5.2f}, clock {clock:5.2f}{verdict}", flush=True)


def files_for(old: Version, folder: Path) -> dict[str, str]:
    """Captures taken and reduced by the older version, whose files the newer one reads too."""
    found = {}
    captures = {
        "drr": "--omega 35",
        "stokes": "--omega 35 --mode stokes",
        "air": "--omega 180 --sample air",
        "large": f"--omega 35 --rig {_large_rig(old, folder)}",
    }
    for key, words in captures.items():
        out = folder / key
        if not out.exists():
            old.run(old.script("acquire", *words.split(), "--exposure", "0.02", "--out", str(out)))
        (found[key],) = (str(path) for path in out.glob("*.h5"))
    for key, capture in (("m", "drr"), ("s", "stokes")):
        found[key] = str(folder / f"{key}.h5")
        if not Path(found[key]).exists():
            old.run(old.script("process", "reduce", found[capture], "--out", found[key], "--no-figure"))
    return found


def _large_rig(old: Version, folder: Path) -> Path:
    """The simulated rig of the older version with a camera of 2048 x 2448 pixels."""
    configs = old.root / "configs"
    text = (configs / "rigs/simulated.yaml").read_text(encoding="utf-8").replace("../", f"{configs}/")
    path = folder / "large_rig.yaml"
    path.write_text(re.sub("rows: .*", "rows: 2048", re.sub("columns: .*", "columns: 2448", text)), encoding="utf-8")
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", help="the earlier commit, or a folder where it is checked out")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", default="", help="lines whose name contains this")
    parser.add_argument("--folder", type=Path, help="captures made there before are taken; else a passing one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = options.folder or Path(name)
        if Path(options.commit).is_dir():
            compare(Version(Path(options.commit).resolve()), Version(ROOT), folder, options.rounds, options.only)
            return
        worktree = Path(name) / "earlier"
        subprocess.run(["git", "-C", ROOT, "worktree", "add", "-q", "--detach", worktree, options.commit], check=True)
        try:
            compare(Version(worktree), Version(ROOT), folder, options.rounds, options.only)
        finally:
            subprocess.run(["git", "-C", ROOT, "worktree", "remove", "--force", worktree], check=True)


def compare(old: Version, new: Version, folder: Path, rounds: int, only: str) -> None:
    """All commands, then all tasks of the bench."""
    commands = {label: words for label, words in COMMANDS.items() if only in label}
    known = files_for(old, folder) if commands else {}
    with tempfile.TemporaryDirectory() as scratch:
        compare_commands(old, new, commands, known, Path(scratch), rounds)
    compare_tasks(old, new, rounds, only)


def compare_commands(
    old: Version, new: Version, commands: dict[str, str], known: dict[str, str], scratch: Path, rounds: int
) -> None:
    """Commands of `process`, each into a new file."""
    count = itertools.count()
    for label, template in commands.items():

        def command(version: Version, template: str = template) -> tuple[float, float]:
            configs = version.root / "configs"
            words = template.format(
                **known,
                out=scratch / f"out{next(count)}",
                geometry=configs / "geometries/one_inch_sphere.yaml",
                instrument=configs / "instruments/rgb950.yaml",
                material=configs / "materials/red_print.yaml",
                free=FREE,
            )
            return version.run(version.script("process", *words.split()))[:2]

        both_in_turns(label, rounds, command, old, new)


def compare_tasks(old: Version, new: Version, rounds: int, only: str) -> None:
    """Tasks of `./lab bench`, by the times that it prints."""
    for task, begins in TASKS.items():
        if only in f"bench: {task}":

            def bench(version: Version, task: str = task, begins: str = begins) -> tuple[float, float]:
                out = version.run([str(version.root / "benchmarks/run.py"), "--no-peers", "--only", task])[2]
                # "NAME: 5.5 ms (best 5.4, processor time of a core 5.4)"
                line = rf"^{begins}.*: ([\d.]+) ms \(best [\d.]+,\s+processor time of a core\s+([\d.]+)\)"
                found = re.findall(line, out, re.MULTILINE)
                return sum(float(core) for _, core in found) / 1000, sum(float(ms) for ms, _ in found) / 1000

            both_in_turns(f"bench: {task}", rounds, bench, old, new)


if __name__ == "__main__":
    main()
