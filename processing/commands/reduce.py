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
    product, facts, simulated = reduce_file(capture, instrument, out, demosaic, overwrite)
    summary(product, facts, simulated)
    if figure is not None:
        from processing.figures import draw_product

        draw_product(product, figure)
        typer.echo(f"figure: {figure}")


def reduce_file(
    path: Path, instrument: Path | None, out: Path | None, demosaic: str | None, overwrite: bool
) -> tuple[Path, dict[str, Any], bool]:
    """Reduce one capture with a progress bar: product file, its facts, and whether the data are simulated."""
    # Tiles are spread over our own threads; a second pool inside BLAS would only fight with them.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from processing.capture import Capture
    from processing.console import progress_bar
    from processing.product import Step, file_identity
    from processing.reduce import choose_model, reduce_mueller
    from processing.reduce_stokes import DEFAULT_METHOD, reduce_stokes

    with Capture(path) as capture:
        kind = "stokes" if capture.header.mosaic else "mueller"
        product = out or path.with_suffix(f".{kind}.h5")
        arguments = {"capture": path.name, "instrument": instrument and str(instrument), "demosaic": demosaic}
        inputs = [file_identity(p) for p in (path, instrument) if p is not None]
        steps = (Step("reduce", arguments, tuple(inputs)),)
        model = choose_model(capture, instrument)
        with progress_bar("reducing", "rows" if kind == "mueller" else "states") as tick:
            if kind == "stokes":
                method = demosaic or DEFAULT_METHOD
                facts = reduce_stokes(capture, model, product, steps, method, overwrite=overwrite, progress=tick)
            else:
                facts = reduce_mueller(capture, model, product, steps, overwrite=overwrite, progress=tick)
        return product, facts, capture.simulated


def reduced(source: Path, instrument: Path | None) -> Path:
    """The product of a capture, made now unless it is there already and newer; a product is returned as it is."""
    from processing.product import is_product

    if is_product(source):
        return source
    for kind in ("mueller", "stokes"):
        product = source.with_suffix(f".{kind}.h5")
        if instrument is None and product.exists() and source.exists() and _newer(product, source):
            typer.echo(f"using {product}")
            return product
    product, facts, simulated = reduce_file(source, instrument, None, None, overwrite=True)
    summary(product, facts, simulated)
    return product


def summary(product: Path, facts: dict[str, Any], simulated: bool) -> None:
    """Print facts, warnings (stderr) and the name of a product."""
    if simulated:
        typer.echo("SIMULATED data")
    for name, value in facts.items():
        if name not in ("warnings", "masked"):
            shown = f"{value:.5g}" if isinstance(value, float) else str(value)
            typer.echo(f"  {name.replace('_', ' ')}: {shown}")
    for warning in facts["warnings"]:
        typer.echo(f"warning: {warning}", err=True)
    typer.echo(str(product))


def _newer(product: Path, source: Path) -> bool:
    return product.stat().st_mtime > source.stat().st_mtime
