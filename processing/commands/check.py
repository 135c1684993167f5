"""`process check`: whether an instrument still measures as it did when a reference was taken."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from processing.commands.purposes import CALIBRATION


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("check", rich_help_panel=CALIBRATION)(check_command)


def check_command(
    capture: Annotated[Path, typer.Argument(help="Capture of today: air, or any sample that is kept for the check.")],
    reference: Annotated[Path, typer.Option(help="Capture of the same sample, taken when the instrument was right.")],
    instrument: Annotated[Path | None, typer.Option(help="Instrument file instead of the one in the captures.")] = None,
    tolerance: Annotated[float, typer.Option(min=0, help="Largest change of M/m00 that counts as unchanged.")] = 0.001,
) -> None:
    """Compare a capture with a kept reference: unchanged, or which elements changed and by what cause.

    Each check adds a row to REFERENCE.checks.csv and redraws REFERENCE.checks.png. The exit code is 1 for a change.
    """
    from processing.campaign.drift import compare, keep
    from processing.commands.progress_bar import progress_bar
    from processing.doors import require_distinct
    from processing.reports.drift_figure import draw_drift

    require_distinct([capture, reference])
    with progress_bar("check", "rows") as tick:
        found = compare(capture, reference, instrument, tolerance, progress=tick)
    if found.simulated:
        typer.echo("SIMULATED data")
    typer.echo(f"{'changed' if found.count else 'unchanged'} since {reference.name}")
    typer.echo(f"  light: {100 * found.light.value:+.2f} +- {100 * found.light.error:.2g} %")
    one, (rows, columns) = found.largest, found.largest.region
    place = f"rows {rows.start}:{rows.stop}, columns {columns.start}:{columns.stop}"
    typer.echo(f"  largest change over m00: {one.name} by {one.value:+.2g} +- {one.error:.1g} in {place}")
    typer.echo(f"  {found.count} of {found.tests} comparisons beyond noise and the tolerance of {tolerance:g}")
    table = keep(found, reference)
    draw_drift(table, table.with_suffix(".png"), reference.name, tolerance, simulated=found.simulated)
    typer.echo(f"{table}\n{table.with_suffix('.png')}")
    if found.count:
        _name_cause(capture, reference, instrument)
        raise typer.Exit(1)


def _name_cause(capture: Path, reference: Path, instrument: Path | None) -> None:
    """Diagnose the capture with the instrument as the reference saw it: the effects that it names are new."""
    from processing.commands.loaded_late.diagnose_summary import show
    from processing.commands.progress_bar import progress_line
    from processing.diagnosis.instrument.diagnose import diagnose_captures
    from processing.diagnosis.instrument_file import extended
    from processing.errors import ProcessError
    from processing.storage.captures.capture import full_model

    model = full_model(reference, instrument)
    with progress_line("diagnose the reference", False) as say:
        before, _ = diagnose_captures([reference], model, say)
    model = extended(model, before.diagnosis)
    try:
        with progress_line("diagnose the change", False) as say:
            judged, _ = diagnose_captures([capture], model, say)
    except ProcessError as error:
        typer.echo(f"the cause is not determined: {error}", err=True)
        return
    typer.echo(f"cause, with the instrument as it was for {reference.name}:")
    show(judged.diagnosis, written=True)
