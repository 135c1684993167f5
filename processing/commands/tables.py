"""`process table`: tables over scattering geometry, their comparison, and the renderer's file."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from processing.commands.command_line import DATA, EXPORT, REFLECTANCE, command
from processing.whole_file import whole_file


@command("table", REFLECTANCE)
def table_command(
    *,
    sources: Annotated[list[Path], typer.Argument(help="Mueller or xi0 products of one wavelength.")],
    geometry: Annotated[Path, typer.Option(help="Geometry file: camera, source, shape.")],
    out: Annotated[Path, typer.Option(help="Table file (HDF5) to write.")],
    layout: Annotated[str, typer.Option(help="Bins: degree (1 degree each) or renderer.")] = "degree",
    white: Annotated[
        Path | None, typer.Option(help="Mueller product of a white plaque: values become a BRDF in 1/sr.")
    ] = None,
    white_geometry: Annotated[Path | None, typer.Option(help="Geometry file of the plaque.")] = None,
    certificate: Annotated[Path | None, typer.Option(help="Its reflectance factor and u: .yaml or .csv.")] = None,
    append: Annotated[bool, typer.Option("--append", help="Add to the table if it exists.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a table of that name.")] = False,
) -> None:
    """Mean, variance and count over theta_h, theta_d, phi_d from any number of images."""
    import numpy as np

    from processing.commands.progress_bar import progress_bar
    from processing.errors import ProcessError
    from processing.reflectance.tables import ScatteringTable
    from processing.steps.table import Tabulation

    if layout not in ("degree", "renderer"):
        raise ProcessError(f"--layout {layout!r}: there are degree and renderer")
    scale = None
    if white is not None and white_geometry is not None and certificate is not None:
        scale = white, white_geometry, certificate
    elif not white is white_geometry is certificate is None:
        raise ProcessError("--white, --white-geometry and --certificate belong together. Give all three.")
    step = Tabulation(tuple(sources), geometry, out, "renderer" if layout == "renderer" else "degree", scale)
    with progress_bar("table", "images") as tick:
        step.append(tick) if append else step.make(overwrite=overwrite, progress=tick)
    table = ScatteringTable.load(out)
    if table.simulated:
        typer.echo("SIMULATED data")
    typer.echo(f"  {', '.join(table.quantities[:4])}{' ...' if len(table.quantities) > 4 else ''}")
    for part, values in table.uncertainties.items():
        typer.echo(f"  {part}, median over bins and quantities: {np.nanmedian(values):.3g}")
    if table.scale_u is not None:
        typer.echo(f"  BRDF in 1/sr; relative standard uncertainty of its scale {100 * table.scale_u:.2g} %")
    typer.echo(f"  bins filled: {table.bins.size} of {91 * 91 * 360}, samples: {int(table.count.sum())}")
    typer.echo(str(out))


@command("compare-tables", REFLECTANCE)
def compare_command(
    *,
    reference: Annotated[Path, typer.Argument(help="Table of xi0 (`process table`, or of a campaign).")],
    other: Annotated[Path, typer.Argument(help="Table of xi0 to compare with it, of the same wavelength.")],
    geometry: Annotated[Path, typer.Option(help="Geometry file of the virtual object and its camera.")],
    omega: Annotated[str, typer.Option(help="Arm angles in degrees, separated by commas.")] = "35",
    size: Annotated[int, typer.Option(min=16, help="Rows and columns of the virtual image.")] = 600,
    figure: Annotated[Path, typer.Option(help="Figure of the first angle (PNG).")] = Path("compare_tables.png"),
) -> None:
    """Evaluate two tables of xi0 on a virtual object and compare them (Jarecki and Kupinski, V-B)."""
    from processing.campaign.run import compare_on_sphere
    from processing.errors import ProcessError
    from processing.geometry.viewing import ViewingGeometry
    from processing.reflectance.tables import ScatteringTable
    from processing.reports.reflectance_figures import tables_figure

    tables = [ScatteringTable.load(p) for p in (reference, other)]
    for path, table in zip((reference, other), tables, strict=True):
        if table.quantities != ("xi0",) or not table.has_noise:
            raise ProcessError(f"{path} holds {', '.join(table.quantities[:3])}; give tables of xi0 products.")
    a, b = tables
    if abs(a.wavelength_nm - b.wavelength_nm) > 0.5:
        raise ProcessError(f"{reference} is at {a.wavelength_nm:g} nm and {other} at {b.wavelength_nm:g} nm.")
    if a.simulated != b.simulated:
        raise ProcessError("one table is simulated and the other measured; they are never compared.")
    try:
        angles = [float(text) for text in omega.split(",")]
    except ValueError as error:
        raise ProcessError(f"--omega {omega!r}: give numbers in degrees, e.g. 20,35,50") from error
    view = ViewingGeometry.load(geometry)
    if a.simulated:
        typer.echo("SIMULATED data")
    typer.echo(f"{a.wavelength_nm:g} nm, RMSD of xi0 on the virtual object, and what uncertainties make of it")
    for path, table in zip((reference, other), tables, strict=True):
        if not table.inputs:
            typer.echo(f"warning: no uncertainty of its instrument is known to {path}; u instr. has none", err=True)
    typer.echo("  Omega     xi0/%    u noise  u instr.    common")
    for angle in angles:
        comparison = compare_on_sphere(a, b, view, angle, shape=(size, size))
        if not comparison["common"]:
            typer.echo(f"  {angle:5g}  no direction in which both tables have a value")
            continue
        shown = (f"{comparison[f'xi0_{part}percent']:9.3f}" for part in ("", "noise_", "systematic_"))
        typer.echo(f"  {angle:5g} {'  '.join(shown)} {comparison['common']:9.3f}")
    with whole_file(figure) as new:
        tables_figure(a, b, view, angles[0], shape=(size, size)).savefig(new, dpi=150)
    typer.echo(str(figure))


@command("export-pbsdf", EXPORT)
def export_command(
    *,
    tables: Annotated[
        list[Path], typer.Argument(help="Mueller tables in the renderer layout, one a wavelength, or a material file.")
    ],
    out: Annotated[Path, typer.Option(help="Renderer file (.pbsdf) to write; about 1 GB.")],
    white_m00: Annotated[
        float, typer.Option(help="M00 of a perfect white surface at normal incidence, of a table without --white.")
    ] = 1.0,
    keep_gaps: Annotated[bool, typer.Option("--keep-gaps", help="Leave empty bins black.")] = False,
    uncertainty: Annotated[bool, typer.Option("--uncertainty", help="Add u of each element; another 1 GB.")] = False,
) -> None:
    """Write tables, or a material of two processes, as a Mitsuba .pbsdf."""
    from processing.commands.progress_bar import progress_bar
    from processing.reflectance.base import load_reflectance
    from processing.reflectance.pbsdf import export, model_table
    from processing.reflectance.tables import ScatteringTable

    read = []
    for path in tables:
        if path.suffix not in (".yaml", ".yml"):
            read.append(ScatteringTable.load(path))
            continue
        material = load_reflectance(path)
        for nm in material.wavelengths_nm:
            with progress_bar(f"{material.name}, {nm:g} nm", "angles") as tick:
                read.append(model_table(material, nm, tick))
    with progress_bar("writing", "wavelengths") as tick:
        gaps: Literal["nearest", "nan"] = "nan" if keep_gaps else "nearest"
        missing = export(read, out, white_m00, gaps, progress=tick, uncertainty=uncertainty)
    filled = "left black" if keep_gaps else "filled with the nearest bin"
    typer.echo(f"  visible bins without a sample: {100 * missing:.1f} %, {filled}")
    typer.echo(str(out))


@command("import-pbsdf", DATA)
def import_command(
    source: Annotated[Path, typer.Argument(help="Renderer file (.pbsdf).")],
    wavelength_nm: Annotated[float, typer.Option(help="Which of its wavelengths.")],
    out: Annotated[Path, typer.Option(help="Table file (HDF5) to write.")],
) -> None:
    """Read one wavelength of a Mitsuba .pbsdf into a table."""
    from processing.errors import ProcessError
    from processing.reflectance.pbsdf import load

    typer.echo(f"  reading three million bins of {source}", err=True)
    tables = load(source, only_nm=wavelength_nm)
    if not tables:
        raise ProcessError(f"{source} has no wavelength {wavelength_nm:g} nm.")
    table = next(iter(tables.values()))
    table.save(out)
    typer.echo(f"  bins: {table.bins.size}")
    typer.echo(str(out))
