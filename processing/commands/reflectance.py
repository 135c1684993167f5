"""`process design --stokes` (through `commands.design`), `fit-material`, `extrapolate`: from and to a model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from processing.commands.batch import captures_and, files_of, make_products
from processing.commands.command_line import REFLECTANCE, Overwrite, ProductFile, command
from processing.commands.drawing import FigureFile, NoFigure
from processing.whole_file import whole_file

if TYPE_CHECKING:
    from processing.calibration.illumination_design import Assumptions
    from processing.steps.file_step import FileStep, Progress, StepProduct


def design_stokes(geometry: Path, material: Path, camera: Path, scene: Assumptions, *, figure: Path) -> None:
    """Recommend the illumination of a Stokes capture from the standard error of xi0 that it predicts."""
    from processing.calibration.illumination_design import linear_states, predict
    from processing.commands.progress_bar import progress_bar
    from processing.geometry.viewing import ViewingGeometry
    from processing.instrument.model import InstrumentModel
    from processing.reflectance.base import load_reflectance
    from processing.reports.reflectance_figures import stokes_design_figure

    view, model, instrument = ViewingGeometry.load(geometry), load_reflectance(material), InstrumentModel.load(camera)
    ranked = {}
    for nm in model.wavelengths_nm:
        with progress_bar(f"{nm:g} nm", "angles") as tick:
            ranked[nm] = predict(view, model, nm, instrument, states=linear_states(), assumptions=scene, progress=tick)
        typer.echo(f"{nm:g} nm   standard error of xi0 over the object and Omega 20 to 90 degrees")
        for p in ranked[nm]:
            worst = int(p.median.argmax())
            typer.echo(
                f"  {p.name:>16}: 90 % of pixels {p.score:.4f}, median at worst {p.median[worst]:.4f} (Omega "
                f"{p.omega_deg[worst]:g}), pixels lost there {100 * p.lost[worst]:.0f} %"
            )
        typer.echo(f"  recommended: {ranked[nm][0].name}")
    with whole_file(figure) as new:
        stokes_design_figure(ranked).savefig(new, dpi=150)
    typer.echo(str(figure))


@command("fit-material", REFLECTANCE)
def fit_material_command(
    *,
    sources: Annotated[list[Path], typer.Argument(help="Products of `process reduce`, one kind, one wavelength.")],
    geometry: Annotated[Path, typer.Option(help="Geometry file: camera, source, shape.")],
    out: Annotated[Path, typer.Option(help="Material file (YAML) to write.")],
    name: Annotated[str, typer.Option(help="Name of the material.")] = "fitted material",
    kind: Annotated[str, typer.Option(help="Model: polarized_diffuse or rough_plastic.")] = "polarized_diffuse",
    correlation: Annotated[bool, typer.Option("--correlation", help="Maximum linear correlation.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file of that name.")] = False,
) -> None:
    """Fit n + i k, a and b: to the dominant process of Mueller images, to other images by maximum linear correlation.

    --correlation takes the second for Mueller images too: it is more precise, and wrong where small eigenvalues differ.
    --kind rough_plastic fits n, alpha and albedo of a rough surface over a volume that depolarizes.
    """
    from processing.doors import require_place
    from processing.steps.material import MaterialFitting

    require_place(out, overwrite)
    fitting = MaterialFitting(tuple(sources), geometry, name, correlation, kind).fitted()
    fit = fitting.fit
    if fitting.simulated:
        typer.echo("SIMULATED data")
    for key, value, stderr in zip(fit.names, fit.constants, fit.stderr, strict=True):
        remark = "" if fit.identified[key] else "   NOT IDENTIFIED by these data"
        typer.echo(f"  {key} = {value:.5g} +- {stderr:.2g}{remark}")
    typer.echo(f"  method: {fit.method}; condition number {fit.condition:.3g}, {fit.pixels} pixels")
    typer.echo(f"  reduced chi-square against the known noise: {fit.chi_square:.3g}")
    if fit.correlation == fit.correlation:
        typer.echo(
            f"  residual over polarized signal: {100 * fit.residual:.2f} %, mean correlation {fit.correlation:.4f}"
        )
    notes = fit.notes([p.name for p in sources])
    typer.echo("\n".join(f"  {note}" for note in notes[3:]))
    fitting.save(out, overwrite)
    typer.echo(str(out))


@command("extrapolate", REFLECTANCE)
def extrapolate_command(
    *,
    sources: Annotated[
        list[Path], typer.Argument(help="Stokes captures or products of `process reduce`, or folders of them.")
    ],
    geometry: Annotated[Path, typer.Option(help="Geometry file: camera, source, shape.")],
    material: Annotated[Path, typer.Option(help="Material file: the dominant process.")],
    out: ProductFile = None,
    figure: FigureFile = None,
    no_figure: NoFigure = False,
    overwrite: Overwrite = False,
) -> None:
    """A full Mueller image from a linear Stokes capture: TD model with the estimated xi0 and M00."""
    from processing.steps.maps import Extrapolation
    from processing.steps.reduction import reduce_or_open

    def step_of(source: Path, tick: Progress) -> tuple[FileStep, StepProduct | None]:
        image = reduce_or_open(source, progress=tick)
        return Extrapolation(image.path, geometry, material), image if image.path != source else None

    inputs = files_of(sources, captures_and(("stokes",)), "Stokes captures")
    make_products(
        "extrapolating", "parts", inputs, step_of, out=out, overwrite=overwrite, figure=figure, no_figure=no_figure
    )
