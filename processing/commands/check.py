"""`process check`: whether an instrument still measures as it did when a reference was taken."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from processing.commands.batch import Output, files_of, run_batch
from processing.commands.command_line import CALIBRATION, command

if TYPE_CHECKING:
    from processing.campaign.drift import Change
    from processing.steps.file_step import Progress


@command("check", CALIBRATION)
def check_command(
    captures: Annotated[
        list[Path], typer.Argument(help="Captures of air or of another sample that is kept, or folders of them.")
    ],
    reference: Annotated[Path, typer.Option(help="Capture of the same sample, taken when the instrument was right.")],
    instrument: Annotated[Path | None, typer.Option(help="Instrument file instead of the one in the captures.")] = None,
    tolerance: Annotated[float, typer.Option(min=0, help="Largest change of M/m00 that counts as unchanged.")] = 0.001,
) -> None:
    """Compare captures with a kept reference: unchanged, or which elements changed and by what cause.

    Each check adds a row to REFERENCE.checks.csv and redraws REFERENCE.checks.png. The exit code is 1 for a change.
    """
    from processing.campaign.drift import comparable, compare, keep
    from processing.doors import require_distinct
    from processing.reports.drift_figure import draw_drift
    from processing.storage.captures.capture import made_of_captures

    conditions = comparable(reference)

    def takes(path: Path) -> bool:
        return not made_of_captures(path) and comparable(path) == conditions and not path.samefile(reference)

    inputs = files_of(captures, takes, f"captures to compare with {reference}")
    changes: dict[Path, Change] = {}

    def make(capture: Path, tick: Progress) -> Output:
        require_distinct([capture, reference])
        change = changes[capture] = compare(capture, reference, instrument, tolerance, progress=tick)
        top, many = change.largest, len(inputs) > 1
        table = keep(change, reference)
        return Output((capture if many else table,), many and not change.count, f"  {top.name} by {top.value:+.2g}")

    def print_result(output: Output) -> None:
        (change,), (table,) = changes.values(), output.paths
        _print_change(change, reference, tolerance)
        typer.echo(f"{table}\n{table.with_suffix('.png')}")

    try:
        run_batch("check", "rows", inputs, make, print_result=print_result, word="changed")
    finally:
        if changes:
            table = reference.with_suffix(".checks.csv")
            is_simulated = any(change.simulated for change in changes.values())
            draw_drift(table, table.with_suffix(".png"), reference.name, tolerance, simulated=is_simulated)
    changed = [path for path, change in changes.items() if change.count]
    if changed:
        newest = max(changed, key=lambda path: changes[path].start_time)
        if len(inputs) > 1:
            typer.echo(f"newest change: {newest}")
        _name_cause(newest, reference, instrument)
        raise typer.Exit(1)


def _print_change(change: Change, reference: Path, tolerance: float) -> None:
    if change.simulated:
        typer.echo("SIMULATED data")
    typer.echo(f"{'changed' if change.count else 'unchanged'} since {reference.name}")
    typer.echo(f"  light: {100 * change.light.value:+.2f} +- {100 * change.light.error:.2g} %")
    largest, (rows, columns) = change.largest, change.largest.region
    place = f"rows {rows.start}:{rows.stop}, columns {columns.start}:{columns.stop}"
    typer.echo(f"  largest change over m00: {largest.name} by {largest.value:+.2g} +- {largest.error:.1g} in {place}")
    typer.echo(f"  {change.count} of {change.tests} comparisons beyond noise and the tolerance of {tolerance:g}")


def _name_cause(capture: Path, reference: Path, instrument: Path | None) -> None:
    """Diagnose the capture with the instrument as the reference saw it: the effects that it names are new."""
    from processing.commands.loaded_late.diagnose_summary import show
    from processing.commands.progress_bar import progress_line
    from processing.diagnosis.instrument.diagnose import diagnose_captures
    from processing.diagnosis.instrument_file import extend_model
    from processing.errors import ProcessError
    from processing.storage.captures.capture import full_model

    model = full_model(reference, instrument)
    with progress_line("diagnose the reference", False) as say:
        before, _ = diagnose_captures([reference], model, say)
    model = extend_model(model, before.diagnosis)
    try:
        with progress_line("diagnose the change", False) as say:
            judged, _ = diagnose_captures([capture], model, say)
    except ProcessError as error:
        typer.echo(f"the cause is not determined: {error}", err=True)
        return
    typer.echo(f"cause, with the instrument as it was for {reference.name}:")
    show(judged.diagnosis, written=True)
