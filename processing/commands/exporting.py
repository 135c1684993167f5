"""`process export`: captures, products and tables in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("export")(export_command)


def export_command(
    source: Annotated[Path, typer.Argument(help="Capture, product, or table of `process table`.")],
    to: Annotated[str, typer.Option(help="tiff, csv, fits, mat, png or pdf.")],
    plane: Annotated[list[str] | None, typer.Option(help="Plane, may be repeated; default: all.")] = None,
    out: Annotated[Path | None, typer.Option(help="File, without or with its ending; default: by the source.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files of that name.")] = False,
) -> None:
    """Write a capture or product as TIFF stacks, CSV, FITS, MATLAB or as a figure for a paper; a table as CSV."""
    from processing.export import export

    for path in export(source, to, out or source.with_suffix(""), plane or (), overwrite):
        typer.echo(str(path))
