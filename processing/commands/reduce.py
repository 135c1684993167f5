"""`process reduce`: a capture to a Mueller or Stokes image."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("reduce")(reduce_command)


def reduce_command(
    capture: Annotated[Path, typer.Argument(help="Capture file (HDF5).")],
    instrument: Annotated[
        Path | None, typer.Option(help="Instrument file to use instead of the one in the capture.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Product file; default: beside the capture.")] = None,
    demosaic: Annotated[str | None, typer.Option(help="Mosaic method; default: the best of docs/mosaic.md.")] = None,
    figure: Annotated[Path | None, typer.Option(help="Also draw the image (PNG).")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a product of that name.")] = False,
) -> None:
    """Invert W per pixel: Mueller image, or Stokes image of a polarization mosaic, with standard errors."""
    # Tiles are spread over our own threads; a second pool inside BLAS would only fight with them.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from processing.capture import Capture
    from processing.console import progress_bar
    from processing.product import Step, file_identity
    from processing.reduce import choose_model, reduce_mueller
    from processing.reduce_stokes import DEFAULT_METHOD, reduce_stokes

    with Capture(capture) as source:
        kind = "stokes" if source.header.mosaic else "mueller"
        product = out or capture.with_suffix(f".{kind}.h5")
        inputs = [file_identity(p) for p in (capture, instrument) if p is not None]
        step = Step(
            "reduce",
            {"capture": capture.name, "instrument": instrument and str(instrument), "demosaic": demosaic},
            tuple(inputs),
        )
        model = choose_model(source, instrument)
        with progress_bar("reducing", "rows") as tick:
            if kind == "stokes":
                method = demosaic or DEFAULT_METHOD
                facts = reduce_stokes(source, model, product, (step,), method, overwrite=overwrite, progress=tick)
            else:
                facts = reduce_mueller(source, model, product, (step,), overwrite=overwrite, progress=tick)
        _summary(product, facts, source.simulated)
    if figure is not None:
        from processing.figures import draw_product

        draw_product(product, figure)
        typer.echo(f"figure: {figure}")


def _summary(product: Path, facts: dict[str, Any], simulated: bool) -> None:
    if simulated:
        typer.echo("SIMULATED data")
    for name, value in facts.items():
        if name not in ("warnings", "masked"):
            shown = f"{value:.5g}" if isinstance(value, float) else str(value)
            typer.echo(f"  {name.replace('_', ' ')}: {shown}")
    for warning in facts["warnings"]:
        typer.echo(f"warning: {warning}", err=True)
    typer.echo(str(product))
