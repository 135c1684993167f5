"""`process reduce`: a capture to a Mueller or Stokes image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from processing.commands.drawing import FigureFile, NoFigure, draw
from processing.commands.product_options import Overwrite, ProductFile
from processing.commands.progress_bar import progress_bar
from processing.commands.summary import summary


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("reduce")(reduce_command)


def reduce_command(
    capture: Annotated[Path, typer.Argument(help="Capture file (HDF5).")],
    instrument: Annotated[
        Path | None, typer.Option(help="Instrument file to use instead of the one in the capture.")
    ] = None,
    out: ProductFile = None,
    weighted: Annotated[bool, typer.Option("--weighted", help="Weigh each intensity by its noise.")] = False,
    covariance: Annotated[
        bool, typer.Option("--covariance", help="Store the 16 x 16 covariance of each pixel (with --weighted).")
    ] = False,
    physical: Annotated[
        str | None, typer.Option(help="Add a physical estimate: nearest, or likelihood (with --weighted).")
    ] = None,
    camera: Annotated[Path | None, typer.Option(help="Noise and bad pixels, from `process camera`.")] = None,
    dark: Annotated[Path | None, typer.Option(help="Other capture whose dark states are subtracted.")] = None,
    flat: Annotated[
        list[Path] | None,
        typer.Option(help="Capture of the flat field to divide by, several times for a mean; or a campaign's folder."),
    ] = None,
    leave_out: Annotated[
        Path | None,
        typer.Option(help="Leave out what `diagnose --json` found to be no measurement: states, hits, bad pixels."),
    ] = None,
    demosaic: Annotated[str | None, typer.Option(help="Mosaic method; default: the best of docs/mosaic.md.")] = None,
    analyzers: Annotated[
        Path | None, typer.Option(help="Mosaic: analysis vectors of the pixels, from `process calibrate-mosaic`.")
    ] = None,
    figure: FigureFile = None,
    no_figure: NoFigure = False,
    overwrite: Overwrite = False,
) -> None:
    """Invert W per pixel: Mueller image, or Stokes image of a polarization mosaic, with standard errors."""
    from processing.steps.reduction import Reduction

    step = Reduction(
        capture,
        instrument,
        weighted,
        covariance,
        physical,
        camera,
        dark,
        tuple(flat or ()),
        leave_out,
        demosaic,
        analyzers,
    )
    with progress_bar("reducing", "rows" if step.kind == "mueller" else "states") as tick:
        product = step.make(out, overwrite, tick)
    summary(product)
    draw(product, figure, no_figure)


def reduced_source(source: Path, instrument: Path | None = None) -> Path:
    """A product as it is; a capture's plain product, found or made with a progress bar, and said."""
    from processing.steps.reduction import reduced

    with progress_bar("reducing", "parts") as tick:
        product, was_there = reduced(source, instrument, tick)
    if product != source:
        typer.echo(f"using {product}") if was_there else summary(product)
    return product
