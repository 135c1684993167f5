"""`process xi0`: Jarecki and Kupinski's xi0 with its standard error and validity mask."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from processing.commands.drawing import FigureFile, NoFigure, draw
from processing.commands.product_options import Overwrite, ProductFile
from processing.commands.progress_bar import progress_bar
from processing.commands.reduce import reduced_source
from processing.commands.summary import summary


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("xi0")(xi0_command)


def xi0_command(
    source: Annotated[Path, typer.Argument(help="Capture, or a product of `process reduce`.")],
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
    from processing.storage.images import seen_elements
    from processing.storage.product import Product

    image = reduced_source(source, instrument)
    with Product(image) as product:
        if product.kind == "mueller" and seen_elements(product.facts).all() and (geometry or material):
            told = "holds whole Mueller matrices: --geometry and --material are not looked at"
            typer.echo(f"warning: {image} {told}", err=True)
    step = Xi0(image, geometry, material)
    with progress_bar("xi0", "rows") as tick:
        made = step.make(out, overwrite, tick)
    summary(made)
    draw(made, figure, no_figure)
