"""Progress of the commands: one progress bar for anything that can take over a second."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

from processing.computing import compile_watch

if TYPE_CHECKING:
    from rich.progress import Progress


class BatchBar:
    """The bar over the inputs of one command, and lines that appear above it."""

    def __init__(self, bar: Progress, inputs: int) -> None:
        self._bar, self._task, self._done = bar, bar.add_task("", total=inputs), 0

    def tick(self, done: int, total: int) -> None:
        """Part of the input that is being processed."""
        self._bar.update(self._task, completed=self._done + done / max(total, 1))

    def finish(self, line: str, failed: bool = False) -> None:
        """Print the line of an input: on stdout, or on stderr for one that failed."""
        self._done += 1
        self._bar.update(self._task, completed=self._done)
        # Bar and lines share a terminal, but stdout may also be a file: the bar makes room for each line.
        self._bar.stop()
        typer.echo(line, err=failed)
        if not self._bar.disable:
            self._bar.start()


@contextmanager
def progress_bar(title: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on stderr, gone at the end; yields a function of (done, in all). Nothing is drawn off a terminal."""
    from rich.progress import MofNCompleteColumn, TextColumn

    with _bar(title, MofNCompleteColumn(), TextColumn(unit)) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@contextmanager
def batch_bar(title: str, inputs: int) -> Iterator[BatchBar]:
    """A bar over `inputs` files, as `progress_bar`."""
    from rich.progress import TextColumn

    with _bar(title, TextColumn("{task.completed:.0f}/{task.total:.0f} files")) as bar:
        yield BatchBar(bar, inputs)


@contextmanager
def _bar(title: str, *counts: object) -> Iterator[Progress]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(title, markup=False), BarColumn(), *counts, TimeRemainingColumn())
    console = Console(stderr=True)

    def compiling() -> None:
        compile_watch.watchers.clear()
        # Within 80 columns, or it would break the bar's line in two.
        console.print("compiling loops, once after an installation: up to half a minute", style="dim", soft_wrap=True)

    compile_watch.watchers.append(compiling)
    try:
        off = not console.is_terminal
        with Progress(*columns, console=console, transient=True, disable=off, redirect_stdout=False) as bar:  # type: ignore[arg-type]
            yield bar
    finally:
        compile_watch.watchers.clear()


@contextmanager
def progress_line(title: str, verbose: bool) -> Iterator[Callable[[str], None]]:
    """One line on stderr with the present step and the seconds so far; yields a function of the step.

    `verbose`: every step stays, on a line of its own. Off a terminal nothing is drawn without it.
    """
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (
        SpinnerColumn(),
        TextColumn(title, markup=False),
        TimeElapsedColumn(),
        TextColumn("{task.description}", markup=False),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=None)

        def say(step: str) -> None:
            # Within the line: a broken one is not taken away at the end.
            progress.update(task, description=step[: max(console.width - len(title) - 14, 0)])
            if verbose:
                console.print(step, soft_wrap=True, markup=False, highlight=False)

        yield say
