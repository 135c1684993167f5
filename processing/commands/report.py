"""`process report` and `show`: a measurement as one self-contained HTML, and what the values of a file do."""

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


@command("show", REPORTS)
def show_command(
    instrument: Annotated[Path, typer.Argument(help="Instrument file, as `diagnose --write` makes it.")],
    wavelength_nm: Annotated[
        float | None, typer.Option(help="Wavelength at which the change of M is taken; default: each value's own.")
    ] = None,
) -> None:
    """List what `diagnose` found: values, standard errors, the captures they hold for, and their change of M."""
    from processing.instrument.influence import influences
    from processing.instrument.model import InstrumentModel

    model = InstrumentModel.load(instrument)
    effects = influences(model, wavelength_nm)
    if not effects:
        typer.echo(f"{instrument}: no value of `diagnose`. Write some: diagnose CAPTURE --write NEW.yaml")
    for influence in effects:
        change = "its change of M depends on the capture"
        if influence.change is not None:
            size = "one standard error" if influence.fitted else "it"
            change = f"{size} changes M/m00 of air by {influence.change:.2g} rms"
        typer.echo(f"{influence.name}: {influence.value}")
        typer.echo(f"  holds for {influence.scope}; {change}")
    for error in model.systematic:
        typer.echo(f"still uncertain: M/m00 by {error.rms_over_m00:.2g} rms, in {len(error.directions)} directions")
