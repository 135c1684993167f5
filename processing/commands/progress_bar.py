"""What commands show while they work: one progress bar for anything that can take over a second."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from processing.computing import compile_watch


@contextmanager
def progress_bar(what: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on stderr, gone at the end; yields a function of (done, in all). Nothing is drawn off a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TextColumn(unit), TimeRemainingColumn())
    console = Console(stderr=True)

    def compiling() -> None:
        compile_watch.watchers.clear()
        # Within 80 columns, or it would break the bar's line in two.
        console.print("compiling loops, once after an installation: up to half a minute", style="dim", soft_wrap=True)

    compile_watch.watchers.append(compiling)
    try:
        with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
            task = progress.add_task(what, total=None)
            yield lambda done, total: progress.update(task, completed=done, total=total)
    finally:
        compile_watch.watchers.clear()
