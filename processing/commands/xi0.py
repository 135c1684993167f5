"""`process xi0`: Jarecki and Kupinski's xi0 with its standard error and validity mask."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from processing.commands.batch import captures_and, files_of, make_products
from processing.commands.command_line import IMAGES, Overwrite, ProductFile, command
from processing.commands.drawing import FigureFile, NoFigure

if TYPE_CHECKING:
    from processing.steps.file_step import FileStep, Progress, StepProduct


@command("xi0", IMAGES)
def xi0_command(
    *,
    sources: Annotated[
        list[Path], typer.Argument(help="Captures or products of `process reduce`, or folders of them.")
    ],
    geometry: Annotated[
        Path | None, typer.Option(help="Geometry file: camera, source, shape (for less than whole matrices).")
    ] = None,
    material: Annotated[
        Path | None, typer.Option(help="Material file: the dominant process (for less than whole matrices).")
    ] = None,
    instrument: Annotated[Path | None, typer.Option(help="Instrument file, where the capture is reduced here.")] = None,
    out: ProductFile = None,
    figure: FigureFile = None,
    no_figure: NoFigure = False,
    overwrite: Overwrite = False,
) -> None:
    """xi0 from a Mueller capture (coherency eigenvalues), or from less with a model (two coefficients)."""
    from processing.steps.maps import Xi0
    from processing.steps.reduction import reduce_or_open
    from processing.storage.products.images import seen_elements
    from processing.storage.products.product import Product

    def step_of(source: Path, tick: Progress) -> tuple[FileStep, StepProduct | None]:
        image = reduce_or_open(source, instrument, tick)
        with Product(image.path) as product:
            if product.kind == "mueller" and seen_elements(product.facts).all() and (geometry or material):
                text = "holds whole Mueller matrices: --geometry and --material are not looked at"
                typer.echo(f"warning: {image.path} {text}", err=True)
        return Xi0(image.path, geometry, material), image if image.path != source else None

    # Without a model of the dominant process, Stokes images have no xi0.
    inputs = files_of(sources, captures_and(("mueller", "stokes") if material else ("mueller",)), "captures for xi0")
    make_products("xi0", "rows", inputs, step_of, out=out, overwrite=overwrite, figure=figure, no_figure=no_figure)
