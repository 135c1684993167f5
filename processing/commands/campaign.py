"""`process campaign`: everything of a folder of captures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from processing.commands.batch import reason_of
from processing.commands.command_line import REPORTS, command
from processing.whole_file import whole_file

if TYPE_CHECKING:
    from processing.campaign.curves import CurvePoint
    from processing.campaign.run import CampaignResult


@command("campaign", REPORTS)
def campaign_command(
    *,
    folder: Annotated[Path, typer.Argument(help="Folder of captures: any samples, angles and instruments.")],
    geometry: Annotated[
        Path | None, typer.Option(help="Geometry file (camera, source, shape), for psi, |D| and xi0.")
    ] = None,
    material: Annotated[Path | None, typer.Option(help="Material file of the dominant process, with it.")] = None,
    stokes_geometry: Annotated[Path | None, typer.Option(help="Geometry of the Stokes camera, if another.")] = None,
    instrument: Annotated[
        Path | None, typer.Option(help="Instrument file of the Mueller captures instead of the one in them.")
    ] = None,
    correct: Annotated[
        bool, typer.Option("--correct", help="Diagnose the folder's captures of air first, and reduce with the result.")
    ] = False,
    region: Annotated[
        str | None, typer.Option(help="Pixels of the means: r0:r1,c0:c1; default: the middle half of the frame.")
    ] = None,
    quantity: Annotated[
        list[str] | None, typer.Option(help="Quantity in the figure of the means; several times for several.")
    ] = None,
    mode: Annotated[
        list[str] | None, typer.Option(help="Take the captures of this mode only; several times for several modes.")
    ] = None,
    sample: Annotated[list[str] | None, typer.Option(help="The same for samples, by their names.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the results; default: FOLDER/campaign.")] = None,
    registered: Annotated[bool, typer.Option("--register", help="Find the sphere in the images.")] = False,
    border: Annotated[int, typer.Option(min=0, help="Pixels along the outline that do not count.")] = 4,
    with_paper: Annotated[
        bool, typer.Option("--paper", help="Print the averages of Jarecki and Kupinski too, of their red sphere.")
    ] = False,
    workers: Annotated[int, typer.Option(min=1, help="Processes on this machine.")] = 1,
    scheduler: Annotated[str | None, typer.Option(help="Address of a dask.distributed scheduler.")] = None,
) -> None:
    """Reduce every capture; means of a region against Omega, or with a geometry RMSD of psi, |D| and xi0.

    A capture that fails is reported, and the others are done. The same command makes only what is missing.
    """
    from processing.campaign.curves import Curves
    from processing.campaign.executors import executor
    from processing.campaign.run import ProcessedCampaign
    from processing.commands.progress_bar import progress_bar
    from processing.errors import ProcessError

    if not folder.is_dir():
        raise ProcessError(f"{folder}: no such folder. Give the folder that holds the captures.")
    if (geometry is None) != (material is None):
        raise ProcessError("--geometry FILE and --material FILE go together. Give both, or neither.")
    if correct and instrument is not None:
        raise ProcessError("--correct makes the instrument file that --instrument names. Give one of the two.")
    if correct and geometry is not None:
        raise ProcessError("--correct is without --geometry. First: process campaign --correct, then --instrument FILE")
    target = out or folder / "campaign"
    selection = tuple(mode or ()), tuple(sample or ())
    if geometry is not None and material is not None:
        step = ProcessedCampaign(
            folder, target, geometry, material, stokes_geometry, registered, border, instrument, *selection
        )
        with executor(workers, scheduler) as pool, progress_bar("campaign", "captures") as tick:
            result = step.run(pool, tick)
        _show_comparison(result, folder.name, target, with_paper)
        left_out, failed = result.left_out, result.failed
    else:
        corrected = _instruments_by_capture(folder, target) if correct else {}
        curves = Curves(folder, target, region, instrument, corrected, *selection)
        with executor(workers, scheduler) as pool, progress_bar("campaign", "captures") as tick:
            results, simulated, omitted = curves.run(pool, tick)
        left_out = tuple(omitted)
        failed = tuple((path, point) for path, point in results if isinstance(point, Exception))
        points = [point for _, point in results if not isinstance(point, Exception)]
        _show_means(points, quantity, folder.name, target, simulated=simulated)
    for text in left_out:
        typer.echo(f"left out: {text}", err=True)
    if failed:
        reasons = [reason_of(path, error) for path, error in failed]
        typer.echo("\n".join(["failed:", *(f"  {text}" for text, _ in reasons)]), err=True)
        count = "1 capture" if len(failed) == 1 else f"{len(failed)} captures"
        typer.echo(f"{count} failed. The same command makes only what is missing.", err=True)
        raise typer.Exit(max(code for _, code in reasons))


def _show_comparison(result: CampaignResult, title: str, target: Path, with_paper: bool) -> None:
    from dataclasses import asdict

    from processing.reports.reflectance_figures import campaign_figure

    if result.simulated:
        typer.echo("SIMULATED data")
    if not result.rows:
        return
    write_rows(target / "campaign.csv", [asdict(row) for row in result.rows])
    with whole_file(target / "campaign.png") as new:
        campaign_figure(result, title, with_paper).savefig(new, dpi=150)
    typer.echo("\n".join(lines(result, with_paper)))
    used = len(set(result.flats.values()))
    typer.echo(f"flat fields: {used}, used by {len(result.flats)} captures" if used else "flat fields: none")
    typer.echo(str(target / "campaign.csv"))
    typer.echo(str(target / "campaign.png"))


def _show_means(
    points: Sequence[CurvePoint], quantities: list[str] | None, title: str, target: Path, *, simulated: bool
) -> None:
    from processing.errors import ProcessError
    from processing.reports.reflectance_figures import CURVES, curves_figure

    if simulated:
        typer.echo("SIMULATED data")
    for point in points:
        by_name = {mean.name: mean for mean in point.means}
        first = by_name[next(name for name in CURVES[2:] if name in by_name)]
        text = f"{first.name.replace('_', ' ')} {first.value:.4g} +- {first.u:.2g}"
        typer.echo(f"{'unchanged' if point.is_unchanged else 'made':10} {point.product}  {text}")
    typer.echo(f"{len(points)} captures reduced")
    if not points:
        return
    rows = [row for point in points for row in point.rows]
    names = {row["quantity"] for row in rows}
    if unknown := [name for name in quantities or () if name not in names]:
        raise ProcessError(f"--quantity {unknown[0]}: no such quantity. There are: {', '.join(sorted(names))}")
    write_rows(target / "means.csv", rows)
    # Air stands at another angle than the samples, and has its rows in the table.
    drawn = [row for point in points if not point.capture.is_reference for row in point.rows] or rows
    names = {row["quantity"] for row in drawn}
    shown = [name for name in quantities or CURVES if name in names][: None if quantities else 6]
    with whole_file(target / "means.png") as new:
        curves_figure(drawn, shown, title, simulated).savefig(new, dpi=150)
    typer.echo(str(target / "means.csv"))
    typer.echo(str(target / "means.png"))


def _instruments_by_capture(folder: Path, target: Path) -> dict[Path, Path]:
    """Instrument file of each capture whose instrument has captures of air in the folder: `diagnose` of these.

    A file that was made of the same captures of air is used again.
    """
    from processing.campaign.captures import find_captures
    from processing.commands.loaded_late.diagnose_summary import show
    from processing.commands.progress_bar import progress_line
    from processing.diagnosis.instrument.diagnose import diagnose_captures
    from processing.diagnosis.instrument_file import WriteError, write_instrument
    from processing.errors import ProcessError
    from processing.storage.captures.capture import Capture, full_model
    from processing.storage.products.provenance import content_of, file_identity

    captures: dict[str, list[Path]] = {}
    airs: dict[str, list[Path]] = {}
    for path, *_ in find_captures(folder, target, of_objects=False).captures:
        with Capture(path) as capture:
            text, is_air = capture.header.instrument_yaml, capture.header.sample.kind == "air"
        captures.setdefault(text, []).append(path)
        if is_air:
            airs.setdefault(text, []).append(path)
    if not airs:
        raise ProcessError(f"{folder} has no capture of air for --correct. Take one: acquire --sample air --omega 180")
    instruments: dict[Path, Path] = {}
    for number, (text, air) in enumerate(airs.items(), 1):
        made_of = "of air: " + ", ".join(f"{path.name} {str(content_of(file_identity(path)))[:16]}" for path in air)
        file = target / ("corrected.yaml" if len(airs) == 1 else f"corrected_{number}.yaml")
        if not (file.exists() and made_of in file.read_text(encoding="utf-8")):
            model = full_model(air[0], None)
            with progress_line("diagnose air", False) as say:
                judged, _ = diagnose_captures(air, model, say)
            show(judged.diagnosis, False, written=True)
            target.mkdir(parents=True, exist_ok=True)
            file.unlink(missing_ok=True)
            try:
                write_instrument(file, model, judged.diagnosis, made_of)
            except WriteError as error:
                typer.echo(f"the captures are reduced with their own models: {error}")
                continue
        typer.echo(f"instrument of {len(captures[text])} captures, by {len(air)} of air: {file}")
        instruments |= dict.fromkeys(captures[text], file)
    return instruments


COLUMNS = (
    ("psi_deg", "psi/deg"),
    ("psi_noise_deg", "its noise"),
    ("magnitude_percent", "|D|/%"),
    ("magnitude_noise_percent", "its noise"),
    ("xi0_percent", "xi0/%"),
    ("xi0_noise_percent", "its noise"),
    ("xi0_systematic_percent", "its instr."),
    ("common", "common"),
    ("eigenvalue_deviation", "eigenvalues"),
    ("eigenvalue_noise", "their noise"),
)


def lines(result: CampaignResult, with_paper: bool) -> list[str]:
    """The table for people: a block a wavelength, its averages, and with the paper Jarecki and Kupinski's."""
    from processing.campaign.run import PAPER

    def row(head: str, values: Sequence[float | None]) -> str:
        cells = [f"{'' if v is None else '-' if v != v else f'{v:.3f}':>11}" for v in values]
        return f"  {head:>5} {' '.join(cells)}".rstrip()

    lines = ["RMSD, and the part of it that the noise of the captures makes (first order)"]
    for nm in sorted({r.wavelength_nm for r in result.rows}):
        lines.append(f"{nm:g} nm")
        lines.append("  Omega " + " ".join(f"{label:>11}" for _, label in COLUMNS))
        for r in (r for r in result.rows if r.wavelength_nm == nm):
            lines.append(row(f"{r.omega_deg:g}", [getattr(r, name) for name, _ in COLUMNS]))
        lines.append(row("mean", [result.average(nm, name) for name, _ in COLUMNS]))
        if with_paper and round(nm) in PAPER:
            p = PAPER[round(nm)]
            lines.append(row("paper", [p.psi_deg, None, p.magnitude_percent, None, p.xi0_percent]))
    lines.append(
        "common: part of the virtual sphere where both instruments have a value; eigenvalues: 99th percentile of "
        "the largest deviation of xi1..xi3 from their mean, without its noise; -: no capture for it"
    )
    return lines


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Rows as comma-separated text, one header line."""
    import csv

    with whole_file(path) as new, new.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
