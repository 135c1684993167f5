"""Benches with many small faults at once: make them, diagnose them, judge the answers against the truth.

    OPENBLAS_NUM_THREADS=1 python benchmarks/real_benches.py DIR --seeds 1-12
    OPENBLAS_NUM_THREADS=1 python benchmarks/real_benches.py DIR --seeds 1-20 --group outside --given joint sphere

Every finished bench is kept as one JSON file in DIR/results: the same command goes on where it was stopped, `--again`
diagnoses anew. Seeds below 1000 are for development; each other seed serves once. Prints the
table of docs/studies/real-benches.md; `--figure` draws the reliability diagram.
"""

import argparse
import json
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

ROOT = Path(__file__).resolve().parents[1]


def judge_one(
    task: tuple[str, int, str], folder: Path, pixels: int, again: bool, *, oracle: bool, polarimeter: dict[str, Any]
) -> dict[str, Any]:
    """Judge one bench as (group, seed, captures given); from its file if it was judged before."""
    from simulators.blind.bench_oracle import read_oracle
    from simulators.blind.bench_run import judge_bench
    from simulators.blind.real_bench import Polarimeter, make_bench, read_truth

    group, seed, capture_set = task
    name = f"{group}_{seed:04d}"
    cache = folder / "results" / f"{name}_{capture_set}.json"
    if cache.exists() and not again:
        return dict(json.loads(cache.read_text(encoding="utf-8"))["judgement"])
    truth = next(read_truth(folder, name), None) or make_bench(
        folder, seed, ROOT / "configs", group, pixels=pixels, polarimeter=Polarimeter(**polarimeter)
    )
    judgement, result = judge_bench(folder, truth, ROOT / "configs", capture_set)
    if oracle:
        judgement = replace(judgement, oracle=read_oracle(folder, truth, ROOT / "configs", capture_set))
    cache.parent.mkdir(exist_ok=True)
    text = json.dumps({"judgement": asdict(judgement), "result": result}, indent=1)
    cache.with_suffix(".partial").write_text(text, encoding="utf-8")
    cache.with_suffix(".partial").replace(cache)
    return asdict(judgement)


def seeds(text: str) -> list[int]:
    """Numbers of "1-12,40"."""
    spans = [part.partition("-") for part in text.split(",")]
    return [n for first, _, last in spans for n in range(int(first), int(last or first) + 1)]


def main() -> None:
    from simulators.blind.bench_judge import GIVEN, judgement_of
    from simulators.blind.bench_table import table
    from simulators.blind.real_bench import GROUPS, PIXELS
    from simulators.blind.reliability_diagram import draw

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=seeds, default=seeds("1-12"), help="as 1-12,40")
    parser.add_argument("--group", nargs="+", choices=list(GROUPS), default=["real"])
    parser.add_argument("--given", nargs="+", choices=list(GIVEN), default=["joint"], help="captures that are given")
    parser.add_argument("--pixels", type=int, default=PIXELS, help="side of the images that are made")
    parser.add_argument("--instrument", help="another file of configs/instruments, in a DIR of its own")
    parser.add_argument("--states", type=int, help="of one capture")
    parser.add_argument("--step", dest="step_deg", type=float, help="of the generator's plate, degrees")
    parser.add_argument("--ratio", type=float, help="the analyzer's plate turns so many times as far")
    parser.add_argument("--again", action="store_true", help="diagnose anew what was judged before")
    parser.add_argument("--no-oracle", action="store_true", help="without the fit of the true set")
    parser.add_argument("--figure", type=Path, help="reliability diagram of all that is judged")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    tasks = list(product(options.group, options.seeds, options.given))
    named = {name: getattr(options, name) for name in ("instrument", "states", "step_deg", "ratio")}
    polarimeter = {name: value for name, value in named.items() if value is not None}
    chosen = {name: getattr(options, name) for name in ("folder", "pixels", "again")}
    run = partial(judge_one, **chosen, oracle=not options.no_oracle, polarimeter=polarimeter)
    judgements = []
    with ProcessPoolExecutor(options.workers) as workers:
        for k, raw in enumerate(workers.map(run, tasks), 1):
            judgements.append(judgement_of(raw))
            print(f"\r{k} of {len(tasks)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    for group, capture_set in product(options.group, options.given):
        print(f"== {group}, {capture_set}")
        print(table([j for j in judgements if (j.group, j.given) == (group, capture_set)]))
    if options.figure:
        draw(judgements, options.figure)


if __name__ == "__main__":
    main()
