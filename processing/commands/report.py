"""`process report`: one self-contained HTML about a measurement."""

from pathlib import Path
from typing import Annotated

import typer

from processing.commands.command_line import REPORTS, command


@command("report", REPORTS)
def report_command(
    sources: Annotated[list[Path], typer.Argument(help="Captures, products, CSV, pictures, or folders of them.")],
    out: Annotated[Path, typer.Option(help="HTML file to write.")] = Path("report.html"),
    title: Annotated[str, typer.Option(help="Heading.")] = "Mueller polarimetry report",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a report of that name.")] = False,
) -> None:
    """One HTML file with figures, numbers, provenance, time ledger and warnings; needs nothing else to be read."""
    from processing.commands.progress_bar import progress_bar
    from processing.reports.report import write_report

    with progress_bar("reporting", "files") as tick:
        written = write_report(sources, out, title, overwrite, progress=tick)
    typer.echo(str(written))
