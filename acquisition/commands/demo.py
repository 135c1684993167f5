"""`./lab demo`: the whole loop on the simulated rig, as one command."""

from __future__ import annotations

import datetime
import random
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from acquisition.commands.defaults import CONFIGS, DEFAULT_RIG

if TYPE_CHECKING:
    from acquisition.demo.loop import Demo, Say
    from acquisition.screen.observer import Observer

#: Side of the frames in pixels: with it the loop takes one to two minutes.
SIDE = 160


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(demo)


def demo(
    seed: Annotated[int | None, typer.Option(min=0, help="repeats a run; by default a new one")] = None,
    faults: Annotated[int, typer.Option(min=1, max=5, help="number of faults that are drawn")] = 2,
    only: Annotated[list[str] | None, typer.Option(help="draw from this kind of fault only; repeatable")] = None,
    out: Annotated[Path, typer.Option(help="folder; each run makes a new folder in it")] = Path("demo"),
) -> None:
    """Draw faults in secret, take captures, diagnose, correct, and compare with the truth. SIMULATED."""
    from acquisition.demo.figure import draw
    from acquisition.demo.summary import cause_rows, figure_rows
    from acquisition.screen.progress import ConsoleProgress
    from processing.commands.loaded_late.diagnose_summary import show
    from processing.commands.progress_bar import progress_line

    seed = random.randrange(10_000) if seed is None else seed
    err, console = Console(stderr=True), Console(highlight=False, soft_wrap=True)
    folder = out / f"{datetime.datetime.now():%Y%m%d-%H%M%S}_seed{seed}"
    options = "".join([f" --faults {faults}" if faults != 2 else "", *(f" --only {kind}" for kind in only or [])])
    console.print(f"SIMULATED. Seed {seed}; repeat with ./lab demo --seed {seed}{options}", style="bold")

    def say(line: str) -> None:
        console.print(line, style="green" if line.startswith("./lab") else "", markup=False)

    result = run_seed(
        folder,
        seed,
        faults,
        only or (),
        say=say,
        progress=lambda: progress_line("diagnose", verbose=False),
        observers=[ConsoleProgress(err)],
    )
    console.print()
    show(result.judged.diagnosis, written=True)
    console.print("\nThe truth is opened", style="bold")
    for fault, effect in cause_rows(result):
        console.print(f"  built in  {fault}\n  found     {effect}", markup=False)
    console.print(f"\n{'':<26}{'before':>18}{'after':>18}{'photon noise':>15}", style="bold")
    for name, before, after, noise in figure_rows(result):
        console.print(f"  {name:<24}{before:>18}{after:>18}{noise:>15}", markup=False)
    console.print(f"\nfigure   {draw(result, folder / 'demo.png')}", markup=False)
    console.print(f"report   {folder / 'report.html'}\ntruth    {folder / 'rig.yaml'}", markup=False)
    console.print(f"{result.seconds:.0f} s", markup=False)


def run_seed(
    folder: Path,
    seed: int,
    faults: int = 2,
    only: Sequence[str] = (),
    *,
    say: Say = lambda line: None,
    progress: Callable[[], AbstractContextManager[Say]] = lambda: nullcontext(lambda step: None),
    observers: Sequence[Observer] = (),
) -> Demo:
    """The demo on the default rig with frames of `SIDE` x `SIDE` pixels; see `run_demo`."""
    from acquisition.capture.plan import MeasurementPlan
    from acquisition.demo.loop import run_demo
    from acquisition.rig.config import load_rig

    rig = load_rig(DEFAULT_RIG)
    assert rig.simulator is not None
    smaller = rig.simulator.model_copy(update={"rows": SIDE, "columns": SIDE})
    plan = MeasurementPlan.load(CONFIGS / "plans" / "drr.yaml")
    rig = rig.model_copy(update={"simulator": smaller})
    return run_demo(rig, plan, folder, seed, count=faults, only=only, say=say, progress=progress, observers=observers)
