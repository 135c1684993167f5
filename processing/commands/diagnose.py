"""The `diagnose` command."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from processing.commands.command_line import Version, application, run
from processing.computing.blas import one_blas_thread
from processing.doors import require_distinct, require_new

app = application("diagnose", "Compare captures with an instrument model and find the effect that the model lacks.")


@app.command()
@one_blas_thread()
def diagnose_command(
    *,
    captures: Annotated[list[Path], typer.Argument(help="Captures of one instrument, at one wavelength or several.")],
    instrument: Annotated[
        Path | None, typer.Option(help="Instrument file to compare with; default: the model in the first capture.")
    ] = None,
    write: Annotated[
        Path | None, typer.Option(help="New file with the effects found: instrument, or material.")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Result as JSON.")] = None,
    report: Annotated[Path | None, typer.Option(help="Report with figures (HTML, one file).")] = None,
    residuals: Annotated[
        Path | None, typer.Option(help="Residuals before and after, pixel by pixel (.npz), of an instrument.")
    ] = None,
    reflectance: Annotated[
        Path | None, typer.Option(help="Material file: the sample is triply degenerate with this dominant process.")
    ] = None,
    geometry: Annotated[Path | None, typer.Option(help="Geometry file of the object, with --reflectance.")] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Print every figure and every step.")] = False,
    version: Version = False,
) -> None:
    """Trace the residual between intensities and model to the effects that explain it; say so if none does."""
    for target in filter(None, (write, json, report, residuals)):
        require_new(target)
    require_distinct(captures)
    if reflectance is not None or geometry is not None:
        from processing.commands.loaded_late.diagnose_surface import diagnose_reflectance

        files = {"write": write, "json": json, "report": report}
        diagnose_reflectance(captures, instrument, reflectance, geometry, **files, verbose=verbose)
        return
    from processing.commands.loaded_late.diagnose_summary import show, write_result
    from processing.commands.progress_bar import progress_line
    from processing.diagnosis.instrument.diagnose import diagnose_captures
    from processing.storage.captures.capture import full_model

    model = full_model(captures[0], instrument)
    with progress_line("diagnose", verbose) as say:
        judged, problem = diagnose_captures(captures, model, say)
    # Files first: who reads the words may go before their end.
    lines = [str(path) for path in (report, residuals, write) if path is not None]
    if json is not None:
        write_result(json, judged.diagnosis)
    if report is not None:
        from processing.diagnosis.instrument.figures import write_report

        write_report(report, judged, problem)
    if residuals is not None:
        from processing.diagnosis.instrument.residual_file import write_residuals

        write_residuals(residuals, judged, problem)
    if write is not None:
        from processing.diagnosis.instrument_file import write_instrument

        write_instrument(write, model, judged.diagnosis)
        if not judged.diagnosis.corrects:
            lines[-1:-1] = [
                "nothing is corrected; the file adds how wrong M may be, for the error bars of `process reduce`"
            ]
    show(judged.diagnosis, verbose, written=write is not None)
    for line in lines:
        typer.echo(line)


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `diagnose`; ends in SystemExit."""
    run(app, argv)


if __name__ == "__main__":
    main()
