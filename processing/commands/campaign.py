"""`process campaign`: everything of a folder of captures, beside Jarecki and Kupinski's averages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from processing.commands.purposes import REPORTS
from processing.whole_file import whole_file

if TYPE_CHECKING:
    from processing.campaign.run import CampaignResult


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("campaign", rich_help_panel=REPORTS)(campaign_command)


def campaign_command(
    folder: Annotated[Path, typer.Argument(help="Folder of captures: Mueller and Stokes, several angles.")],
    geometry: Annotated[Path, typer.Option(help="Geometry file: camera, source, shape.")],
    material: Annotated[Path, typer.Option(help="Material file: the dominant process.")],
    stokes_geometry: Annotated[Path | None, typer.Option(help="Geometry of the Stokes camera, if another.")] = None,
    instrument: Annotated[
        Path | None, typer.Option(help="Instrument file of the Mueller captures instead of the one in them.")
    ] = None,
    mode: Annotated[
        list[str] | None, typer.Option(help="Take the captures of this mode only; several times for several modes.")
    ] = None,
    sample: Annotated[list[str] | None, typer.Option(help="The same for samples, by their names.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the results; default: FOLDER/campaign.")] = None,
    registered: Annotated[bool, typer.Option("--register", help="Find the sphere in the images.")] = False,
    border: Annotated[int, typer.Option(min=0, help="Pixels along the outline that do not count.")] = 4,
    workers: Annotated[int, typer.Option(min=1, help="Processes on this machine.")] = 1,
    scheduler: Annotated[str | None, typer.Option(help="Address of a dask.distributed scheduler.")] = None,
) -> None:
    """Reduce everything, compare DRR, Stokes and model: RMSD of psi, |D| and xi0 against Omega."""
    from processing.campaign.executors import executor
    from processing.campaign.run import Campaign
    from processing.commands.progress_bar import progress_bar
    from processing.errors import ProcessError
    from processing.reports.reflectance_figures import campaign_figure

    if not folder.is_dir():
        raise ProcessError(f"{folder}: no such folder. Give the folder that holds the captures.")
    target = out or folder / "campaign"
    chosen = tuple(mode or ()), tuple(sample or ())
    step = Campaign(folder, target, geometry, material, stokes_geometry, registered, border, instrument, *chosen)
    with executor(workers, scheduler) as pool, progress_bar("campaign", "captures") as tick:
        result = step.run(pool, tick)
    write_csv(result, target / "campaign.csv")
    with whole_file(target / "campaign.png") as new:
        campaign_figure(result, folder.name).savefig(new, dpi=150)
    if result.simulated:
        typer.echo("SIMULATED data")
    typer.echo("\n".join(lines(result)))
    used = len(set(result.flats.values()))
    typer.echo(f"flat fields: {used}, used by {len(result.flats)} captures" if used else "flat fields: none")
    for text in result.left_out:
        typer.echo(f"left out: {text}", err=True)
    typer.echo(str(target / "campaign.csv"))
    typer.echo(str(target / "campaign.png"))


COLUMNS = (
    ("psi_deg", "psi/deg"),
    ("psi_noise_deg", "its noise"),
    ("magnitude_percent", "|D|/%"),
    ("magnitude_noise_percent", "its noise"),
    ("xi0_percent", "xi0/%"),
    ("xi0_noise_percent", "its noise"),
    ("common", "common"),
    ("eigenvalue_deviation", "eigenvalues"),
    ("eigenvalue_noise", "their noise"),
)


def lines(result: CampaignResult) -> list[str]:
    """The table for people: a block a wavelength, its averages, and Jarecki and Kupinski's."""
    from processing.campaign.run import PAPER

    def row(head: str, values: Sequence[float | None]) -> str:
        cells = [f"{'' if v is None else '-' if v != v else f'{v:.3f}':>11}" for v in values]
        return f"  {head:>5} {' '.join(cells)}".rstrip()

    out = ["RMSD, and the part of it that the noise of the captures makes (first order)"]
    for nm in sorted({r.wavelength_nm for r in result.rows}):
        out.append(f"{nm:g} nm")
        out.append("  Omega " + " ".join(f"{label:>11}" for _, label in COLUMNS))
        for r in (r for r in result.rows if r.wavelength_nm == nm):
            out.append(row(f"{r.omega_deg:g}", [getattr(r, name) for name, _ in COLUMNS]))
        out.append(row("mean", [result.average(nm, name) for name, _ in COLUMNS]))
        if round(nm) in PAPER:
            p = PAPER[round(nm)]
            out.append(row("paper", [p.psi_deg, None, p.magnitude_percent, None, p.xi0_percent]))
    out.append(
        "common: part of the virtual sphere where both instruments have a value; eigenvalues: 99th percentile of "
        "the largest deviation of xi1..xi3 from their mean, without its noise; -: no capture for it"
    )
    return out


def write_csv(result: CampaignResult, path: Path) -> None:
    """All rows as comma-separated text, one header line."""
    import csv
    from dataclasses import asdict

    with whole_file(path) as new, new.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(asdict(result.rows[0])))
        writer.writeheader()
        writer.writerows(asdict(row) for row in result.rows)
