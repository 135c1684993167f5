"""`process reduce`: a capture to a Mueller or Stokes image."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from processing.commands.batch import files_of, make_products
from processing.commands.command_line import IMAGES, Overwrite, ProductFile, command
from processing.commands.drawing import FigureFile, NoFigure

if TYPE_CHECKING:
    from processing.steps.file_step import FileStep, Progress


@command("reduce", IMAGES)
def reduce_command(
    *,
    captures: Annotated[list[Path], typer.Argument(help="Captures (HDF5), or folders of them.")],
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
    from processing.storage.captures.capture import made_of_captures

    def step_of(capture: Path, tick: Progress) -> tuple[FileStep, None]:
        flats = tuple(flat or ())
        options = (instrument, weighted, covariance, physical, camera, dark, flats, leave_out, demosaic, analyzers)
        return Reduction(capture, *options), None

    inputs = files_of(captures, lambda path: not made_of_captures(path), "captures")
    make_products(
        "reducing", "parts", inputs, step_of, out=out, overwrite=overwrite, figure=figure, no_figure=no_figure
    )
