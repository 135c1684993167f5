"""`process xi0`: the paper's xi0 with its standard error and validity mask."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from processing.commands.drawing import FigureFile, NoFigure, draw


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("xi0")(xi0_command)


def xi0_command(
    source: Annotated[Path, typer.Argument(help="Capture, or a product of `process reduce`.")],
    geometry: Annotated[
        Path | None, typer.Option(help="Geometry file: camera, source, shape (needed for a Stokes capture).")
    ] = None,
    material: Annotated[
        Path | None, typer.Option(help="Material file: the dominant process (needed for a Stokes capture).")
    ] = None,
    instrument: Annotated[Path | None, typer.Option(help="Instrument file, where the capture is reduced here.")] = None,
    out: Annotated[Path | None, typer.Option(help="Product file; default: beside the source.")] = None,
    figure: FigureFile = None,
    no_figure: NoFigure = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a product of that name.")] = False,
) -> None:
    """xi0 from a Mueller capture (coherency eigenvalues) or a linear Stokes capture (two coefficients)."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from processing.commands.progress_bar import progress_bar
    from processing.commands.reduce import reduced, summary
    from processing.errors import ProcessError
    from processing.maps.xi0 import xi0_of_mueller, xi0_of_stokes
    from processing.storage.product import Product, Step, file_identity

    product = reduced(source, instrument)
    target = out or product.with_name(product.name.removesuffix(".h5").rsplit(".", 1)[0] + ".xi0.h5")
    with Product(product) as opened:
        kind, simulated = opened.kind, opened.simulated
    given = {"geometry": geometry and str(geometry), "material": material and str(material)}
    inputs = [file_identity(p) for p in (product, geometry, material) if p is not None]
    step = Step("xi0", {"source": product.name} | given, tuple(inputs))
    if kind == "stokes":
        if geometry is None or material is None:
            raise ProcessError(
                "a linear Stokes capture gives xi0 only with a model of the dominant process: "
                "give --geometry FILE and --material FILE."
            )
        facts = xi0_of_stokes(product, geometry, material, target, step, overwrite)
    else:
        with progress_bar("xi0", "rows") as tick:
            facts = xi0_of_mueller(product, target, step, overwrite, tick)
    summary(target, facts, simulated)
    draw(target, figure, no_figure)
