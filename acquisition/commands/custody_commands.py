"""The commands `acquire verify` and `acquire repair`."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from acquisition.commands.doctor import Finding

Folder = Annotated[Path, typer.Argument(help="folder of captures, or of a campaign", exists=True, file_okay=False)]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(verify)
    app.command()(repair)
    app.command()(compress)


def verify(folder: Folder) -> None:
    """Read every capture of a folder and name what is damaged or half done. Exit code 1 if anything is damaged."""
    from acquisition.commands.custody import verify as look

    _show(look(folder))


def repair(folder: Folder) -> None:
    """Finish what a kill left half done: seal whole captures, remove strays, make the index anew. Removes no state."""
    from acquisition.commands.custody import repair as mend

    _show(mend(folder))


def compress(folder: Folder) -> None:
    """Write each complete capture of a folder anew, compressed without loss, once its copy was read back.

    Products that were made from them before are made anew when they are asked for: the files have other bytes.
    """
    from acquisition.commands.custody import compressed

    _show(compressed(folder))


def _show(findings: Iterable[Finding]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, show_header=False, pad_edge=False)
    wrong = 0
    for finding in findings:
        style = "bold red" if finding.well is False else ""
        mark = {True: "ok", False: "BAD", None: ""}[finding.well]
        table.add_row(Text(mark, style), Text(finding.what), Text(finding.found, style))
        wrong += finding.well is False
    Console(width=None if sys.stdout.isatty() else 10_000).print(table)
    if wrong:
        raise typer.Exit(1)
