"""How the benchmarks measure: ours and each peer in turns, medians, processor time, one format for every task."""

import contextlib
import os
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from processing.computing.threads import thread_count

SMALL, LARGE = (600, 600), (2048, 2448)
#: Rounds of peers that take seconds.
SLOW_ROUNDS = 2


class Spent(NamedTuple):
    """What one run cost: wall time and processor time of all cores, in seconds."""

    wall_s: float
    processor_s: float


@dataclass
class Task:
    """One line of the table.

    Attributes
    ----------
    target_ms : limit of the median; None where the limit is a ratio.
    ours : does the work once; returns its cost where only a part of it counts, or it is another process.
    peers : seconds of one run of each, by name; a peer that is scaled up says so in its name.
    at_most : (peer, factor): ours must stay within that factor of that peer.
    rounds : how often at most, for tasks that take seconds.
    also : after the last round, more lines: name, value, target, unit.
    """

    name: str
    target_ms: float | None
    ours: Callable[[], object]
    peers: dict[str, Callable[[], float]] = field(default_factory=dict)
    at_most: tuple[str, float] | None = None
    rounds: int | None = None
    also: Callable[[], list[tuple[str, float, float, str]]] = list


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one call."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def measure_cost(work: Callable[[], object]) -> Spent:
    """Cost of one call; the value that it returns if it measures itself."""
    wall, processor = time.perf_counter(), time.process_time()
    result = work()
    if isinstance(result, Spent):
        return result
    return Spent(time.perf_counter() - wall, time.process_time() - processor)


class Program:
    """Another program as a task; remembers the largest memory that it held."""

    def __init__(self, argv: Sequence[str | Path], **options: Any) -> None:
        self.argv, self.options = [str(a) for a in argv], options
        self.peak_mib = 0.0

    def __call__(self) -> Spent:
        before, begin = os.times(), time.perf_counter()
        with subprocess.Popen(
            self.argv, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, **self.options
        ) as run:
            while run.poll() is None:
                self.peak_mib = max(self.peak_mib, _peak_mib(run.pid))
                time.sleep(0.005)
            wall, after = time.perf_counter() - begin, os.times()
            if run.returncode:
                message = run.stderr.read() if run.stderr else ""
                raise SystemExit(f"{' '.join(self.argv)} ended with {run.returncode}:\n{message}")
        children = [t.children_user + t.children_system for t in (before, after)]
        return Spent(wall, children[1] - children[0])


def _peak_mib(pid: int) -> float:
    # Not getrusage: a child's figure there begins with the memory of the process that it was forked from.
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    return 0.0


def measure(task: Task, repeats: int, console: Console, busy: bool) -> bool:
    """Run a task and its peers in turns and print its lines; false if a target was missed."""
    rounds = min(repeats, task.rounds or repeats)
    if task.rounds is None:
        task.ours()  # compiles, and touches the memory
    costs: list[Spent] = []
    ratios: dict[str, list[float]] = {name: [] for name in task.peers}
    times: dict[str, list[float]] = {name: [] for name in task.peers}
    silent: dict[str, str] = {}
    for k in range(rounds):
        costs.append(measure_cost(task.ours))
        for name, run in task.peers.items():
            if name in silent or (k >= SLOW_ROUNDS and times[name] and times[name][-1] > 1):
                continue
            try:
                times[name].append(run())
            except RuntimeError as error:
                silent[name] = str(error)
                continue
            ratios[name].append(times[name][-1] / costs[-1].wall_s)
    walls, cores = [1000 * s.wall_s for s in costs], [1000 * s.processor_s / thread_count() for s in costs]
    ours, core = float(np.median(walls)), float(np.median(cores))
    lines = [f"{task.name}: {ours:.1f} ms (best {min(walls):.1f}, processor time of a core {core:.1f})"]
    met = True
    if task.target_ms is not None:
        met = ours <= task.target_ms
        verdict = "met" if met else "MISSED"
        if not met and busy and core <= task.target_ms:
            verdict = "not judged, other programs are busy"
        lines[0] += f", target {task.target_ms:g} ms: {verdict}"
    if task.at_most:
        peer, factor = task.at_most
        ratio = 1 / float(np.median(ratios[peer]))
        met = met and ratio <= factor
        verdict = "met" if ratio <= factor else "MISSED"
        lines[0] += f", {ratio:.2f} x {peer}, target {factor:g} x: {verdict}"
    for name, value, target, unit in task.also():
        # Memory is the same on a busy machine, shares of time are not.
        unfair = busy and unit == "%"
        verdict = "met" if value <= target else "not judged, other programs are busy" if unfair else "MISSED"
        met = met and value <= target
        lines.append(f"    {name}: {value:.3g} {unit}, target {target:g} {unit}: {verdict}")
    console.print("\n".join(lines), style="bold")
    for name in task.peers:
        if name in silent:
            console.print(f"    {name:<36} did not run: {silent[name][:80]}")
        else:
            median, ratio = 1000 * np.median(times[name]), np.median(ratios[name])
            console.print(f"    {name:<36} {median:10.1f} ms   {ratio:8.1f} x ours")
    return met
