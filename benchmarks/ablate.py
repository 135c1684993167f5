"""Effect of each number of the diagnosis: benches with many faults, judged with it halved and doubled.

    ./lab ablate                          every prior, price and cost
    ./lab ablate TAKES_PART PRICE         these alone
    ./lab ablate --seeds 1-8 --given joint

A line for each number and factor: the error of M of a sample that nobody diagnosed over that with the number as it is
(median), benches made worse, sure names that are right and wrong, and verdicts that change. A number that changes
nothing has no reason to be one. Seeds below 1000 are for development.
"""

import argparse
import importlib
import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from real_benches import seeds as seeds_of

ROOT = Path(__file__).resolve().parents[1]
#: Modules whose public numbers decide.
MODULES = ("processing.diagnosis.search.rules", "processing.instrument.grammar")
FACTORS = (0.5, 2.0)


def numbers() -> dict[str, str]:
    """Names of the numbers, each with its module."""
    module_of = {}
    for module in MODULES:
        for name, value in vars(importlib.import_module(module)).items():
            if name.isupper() and isinstance(value, int | float | np.ndarray) and not isinstance(value, bool):
                module_of[name] = module
    return module_of


def change(name: str, factor: float) -> None:
    """Change a number before any other module has read it; without a name, none."""
    if not name:
        return
    module = importlib.import_module(numbers()[name])
    value = getattr(module, name)
    changed = value * factor
    setattr(module, name, max(1, round(changed)) if isinstance(value, int) else changed)


def judge_benches(folder: Path, seeds: Sequence[int], capture_set: str) -> list[dict[str, Any]]:
    """What became of each bench with the numbers as they are in this process."""
    from simulators.blind.bench_run import judge_bench
    from simulators.blind.real_bench import read_truth

    out = []
    for seed in seeds:
        truth = next(iter(read_truth(folder, f"real_{seed:04d}")))
        judgement, _ = judge_bench(folder, truth, ROOT / "configs", capture_set)
        sure = [c for c in judgement.causes if c.certainty == "sure"]
        out.append(
            {
                "declared": judgement.declared,
                "corrected": judgement.corrected,
                "verdict": judgement.verdict,
                "right": sum(c.right for c in sure),
                "wrong": sum(not c.right for c in sure),
            }
        )
    return out


def judge_in_process(
    folder: Path, seeds: Sequence[int], capture_set: str, name: str = "", *, factor: float = 1.0
) -> list[dict[str, Any]]:
    """The same in a new process, which reads the changed number."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), change, (name, factor)) as process:
        return process.submit(judge_benches, folder, seeds, capture_set).result()


def row(now: Sequence[dict[str, Any]], plain: Sequence[dict[str, Any]]) -> str:
    """One line of the table."""
    ratio = np.median([a["corrected"] / max(b["corrected"], 1e-12) for a, b in zip(now, plain, strict=True)])
    worse = sum(a["corrected"] > 1.02 * a["declared"] for a in now)
    verdicts = sum(a["verdict"] != b["verdict"] for a, b in zip(now, plain, strict=True))
    right, wrong = (sum(a[key] for a in now) for key in ("right", "wrong"))
    return f"{ratio:8.2f} {worse:6d} {right:6d} {wrong:6d} {verdicts:9d}"


def lines(names: Sequence[str], folder: Path, seeds: Sequence[int], capture_set: str) -> Iterator[str]:
    """The table, a line as soon as it is known."""
    plain = judge_in_process(folder, seeds, capture_set)
    yield f"{'number':28s} {'factor':>6s} {'M ratio':>8s} {'worse':>6s} {'right':>6s} {'wrong':>6s} {'verdicts':>9s}"
    yield f"{'as they are':28s} {'':6s} {row(plain, plain)}"
    for name in names:
        for factor in FACTORS:
            changed = judge_in_process(folder, seeds, capture_set, name, factor=factor)
            yield f"{name:28s} {factor:6g} {row(changed, plain)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="numbers to change; default: all")
    parser.add_argument("--seeds", type=seeds_of, default=seeds_of("1-6"), help="as 1-6,9")
    parser.add_argument("--given", default="sphere", help="captures that are diagnosed: sphere or joint")
    parser.add_argument("--pixels", type=int, default=32)
    options = parser.parse_args()
    if unknown := set(options.names) - set(numbers()):
        parser.error(f"no such number: {', '.join(sorted(unknown))}; there are: {', '.join(sorted(numbers()))}")
    from simulators.blind.real_bench import make_bench

    folder = Path(mkdtemp(prefix="ablate_"))
    for seed in options.seeds:
        make_bench(folder, seed, ROOT / "configs", "real", pixels=options.pixels)
    for line in lines(options.names or sorted(numbers()), folder, options.seeds, options.given):
        print(line, flush=True)


if __name__ == "__main__":
    main()
