"""`diagnose --reflectance`: the dominant process of a material in place of an unknown sample."""

from collections.abc import Sequence
from pathlib import Path

import typer

from processing.diagnosis.surface.diagnose import SurfaceDiagnosis
from processing.doors import require_new
from processing.errors import ProcessError


def diagnose_reflectance(
    captures: Sequence[Path],
    instrument: Path | None,
    reflectance: Path | None,
    geometry: Path | None,
    *,
    write: Path | None,
    json: Path | None,
    report: Path | None,
    verbose: bool,
) -> None:
    """Diagnose, print a summary and write what was asked for. Raises ProcessError."""
    if reflectance is None or geometry is None:
        raise ProcessError("a diagnosis of the reflectance needs both --reflectance MATERIAL and --geometry GEOMETRY.")
    from processing.commands.loaded_late.diagnose_summary import show, write_result
    from processing.commands.progress_bar import progress_line
    from processing.diagnosis.surface.diagnose import diagnose_object
    from processing.diagnosis.surface.write import targets, write_surface
    from processing.geometry.viewing import ViewingGeometry
    from processing.reflectance.base import load_reflectance
    from processing.storage.captures.capture import full_model

    for target in targets(write) if write is not None else ():
        require_new(target)
    model, material, view = (
        full_model(captures[0], instrument),
        load_reflectance(reflectance),
        ViewingGeometry.load(geometry),
    )
    with progress_line("diagnose", verbose) as say:
        judged, problem = diagnose_object(captures, model, material, view, say=say)
    # Files first: who reads the words may go before their end.
    files = []
    if json is not None:
        write_result(json, judged.diagnosis)
    if report is not None:
        from processing.diagnosis.surface.figures import write_surface_report

        write_surface_report(report, judged, problem)
        files.append(report)
    if write is not None:
        files += write_surface(write, judged.diagnosis, material, view, instrument=model)
    show(judged.diagnosis, verbose, written=write is not None)
    _show_surface(judged.diagnosis)
    for path in files:
        typer.echo(str(path))


def _show_surface(d: SurfaceDiagnosis) -> None:
    typer.echo(f"  {d.material}: " + ", ".join(f"{name} = {value:.4g}" for name, value in d.constants.items()))
    rows = zip(d.captures, d.quantities_before, d.quantities_after, d.xi0_change, strict=True)
    for capture, before, after, change in rows:
        typer.echo(f"  {capture.name}: median xi0 {before.xi0:.4f} -> {after.xi0:.4f}, rms change {change:.4f}")
        if before.psi_deg is not None and after.psi_deg is not None:
            typer.echo(
                f"    modelled against measured dominant process: psi {before.psi_deg:.1f} -> {after.psi_deg:.1f} "
                f"degrees, |D| {before.magnitude_percent:.1f} -> {after.magnitude_percent:.1f} % (noise alone: "
                f"{after.psi_noise_deg:.1f} degrees, {after.magnitude_noise_percent:.1f} %)"
            )
