"""The commands `acquire verify`, `acquire repair` and `acquire compress`."""

from __future__ import annotations

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

    _show(folder, look(folder))


def repair(folder: Folder) -> None:
    """Finish what a kill left half done: seal whole captures, remove strays, make the index anew. Removes no state."""
    from acquisition.commands.custody import repair as mend

    _show(folder, mend(folder))


def compress(folder: Folder) -> None:
    """Write each complete capture of a folder anew, compressed without loss, once its copy was read back.

    Products that were made from them before are made anew when they are asked for: the files have other bytes.
    """
    from acquisition.commands.custody import compressed

    _show(folder, compressed(folder))


def _show(folder: Path, findings: Iterable[Finding]) -> None:
    from acquisition.screen.rows import print_rows
    from processing.errors import ProcessError

    results = list(findings)
    if not results:
        raise ProcessError(f"{folder}: there is no capture in this folder. Name the one that holds the .h5 files.")
    print_rows(finding.row for finding in results)
    if any(finding.well is False for finding in results):
        raise typer.Exit(1)
