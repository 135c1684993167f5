"""`process reduce`: a capture to a Mueller or Stokes image."""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from processing.commands.drawing import FigureFile, NoFigure, draw


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("reduce")(reduce_command)


def reduce_command(
    capture: Annotated[Path, typer.Argument(help="Capture file (HDF5).")],
    instrument: Annotated[
        Path | None, typer.Option(help="Instrument file to use instead of the one in the capture.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Product file; default: beside the capture.")] = None,
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
    demosaic: Annotated[str | None, typer.Option(help="Mosaic method; default: the best of docs/mosaic.md.")] = None,
    analyzers: Annotated[
        Path | None, typer.Option(help="Mosaic: analysis vectors of the pixels, from `process calibrate-mosaic`.")
    ] = None,
    figure: FigureFile = None,
    no_figure: NoFigure = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a product of that name.")] = False,
) -> None:
    """Invert W per pixel: Mueller image, or Stokes image of a polarization mosaic, with standard errors."""
    options = ReduceOptions(
        instrument, weighted, covariance, physical, camera, dark, tuple(flat or ()), demosaic, analyzers
    )
    product, facts, simulated = reduce_file(capture, out, options, overwrite)
    summary(product, facts, simulated)
    draw(product, figure, no_figure)


#: Endings of the names of facts that are standard errors of other facts.
ERRORS = ("_error", "_stderr")


@dataclass(frozen=True)
class ReduceOptions:
    """What `process reduce` was asked for; all of it goes into the provenance."""

    instrument: Path | None = None
    weighted: bool = False
    covariance: bool = False
    physical: str | None = None
    camera: Path | None = None
    dark: Path | None = None
    flat: tuple[Path, ...] = ()
    demosaic: str | None = None
    analyzers: Path | None = None


def reduce_file(path: Path, out: Path | None, options: ReduceOptions, overwrite: bool) -> tuple[Path, Any, bool]:
    """Reduce one capture with a progress bar: product file, its facts, and whether the data are simulated."""
    # Tiles are spread over our own threads; a second pool inside BLAS would only fight with them.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from processing.calibration.photon_transfer import read_camera
    from processing.commands.progress_bar import progress_bar
    from processing.errors import ProcessError
    from processing.reduction.counts_to_signal import Correction
    from processing.reduction.mueller import Choice, choose_model, reduce_mueller
    from processing.storage.capture import Capture
    from processing.storage.product import Step, file_identity

    with ExitStack() as stack:
        capture = stack.enter_context(Capture(path))
        dark = stack.enter_context(Capture(options.dark)) if options.dark else None
        flat_files = [_flat_file(p, capture) for p in options.flat]
        flats = [stack.enter_context(Capture(p)) for p in flat_files]
        noise, bad = read_camera(options.camera) if options.camera else (None, None)
        correction = Correction.of(capture, bad, dark, flats)
        kind = "stokes" if capture.header.mosaic else "mueller"
        product = out or path.with_suffix(f".{kind}.h5")
        given = (path, options.instrument, options.camera, options.dark, *flat_files, options.analyzers)
        files = [p for p in given if p is not None]
        arguments = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(options).items()}
        arguments["flat"] = ", ".join(str(p) for p in flat_files) or None
        steps = (Step("reduce", {"capture": path.name} | arguments, tuple(file_identity(p) for p in files)),)
        model = choose_model(capture, options.instrument)
        tick = stack.enter_context(progress_bar("reducing", "rows" if kind == "mueller" else "states"))
        if kind == "mueller":
            if options.demosaic or options.analyzers:
                raise ProcessError(f"--demosaic and --analyzers: {path} is not a mosaic capture.")
            choice = Choice(options.weighted, options.covariance, options.physical, noise)
            facts = reduce_mueller(capture, model, product, steps, correction, choice, overwrite, tick)
        else:
            if options.weighted or options.covariance or options.physical:
                raise ProcessError(
                    f"{path} is a mosaic capture: its product holds the covariance of S always; "
                    "--weighted, --covariance and --physical are for Mueller captures."
                )
            # Imported here: OpenCV is not needed for a Mueller capture.
            from processing.reduction.mosaic.pixel_response import read_response
            from processing.reduction.stokes import DEFAULT_METHOD, reduce_stokes

            method = options.demosaic or DEFAULT_METHOD
            response = read_response(options.analyzers, capture.frame_shape) if options.analyzers else None
            facts = reduce_stokes(capture, model, product, steps, method, correction, noise, response, overwrite, tick)
        return product, facts, capture.simulated


def _flat_file(path: Path, capture: Any) -> Path:
    """The flat capture itself, or the one of a folder that belongs to the capture."""
    from processing.errors import ProcessError
    from processing.reduction.flat import flat_captures, nearest_flat

    if not path.is_dir():
        return path
    found = nearest_flat(flat_captures(path), capture)
    if found is None:
        raise ProcessError(
            f"{path} holds no flat field of the camera and wavelength of {capture.path.name}. "
            "Take one (plan key `role: flat`), or leave --flat away."
        )
    return found


def reduced(source: Path, instrument: Path | None) -> Path:
    """The product of a capture, made now unless it is there already and newer; a product is returned as it is."""
    from processing.storage.product import is_product

    if is_product(source):
        return source
    for kind in ("mueller", "stokes"):
        product = source.with_suffix(f".{kind}.h5")
        if instrument is None and product.exists() and source.exists() and _newer(product, source):
            typer.echo(f"using {product}")
            return product
    product, facts, simulated = reduce_file(source, None, ReduceOptions(instrument), overwrite=True)
    summary(product, facts, simulated)
    return product


def summary(product: Path, facts: dict[str, Any], simulated: bool) -> None:
    """Print facts, warnings (stderr) and the name of a product."""
    if simulated:
        typer.echo("SIMULATED data")
    for name, value in facts.items():
        if name not in ("warnings", "masked") and not name.endswith(ERRORS):
            typer.echo(f"  {name.replace('_', ' ')}: {_shown(value)}{_with_error(name, facts)}")
    for warning in facts["warnings"]:
        typer.echo(f"warning: {warning}", err=True)
    typer.echo(str(product))


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or value != value:
        return "none"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _with_error(name: str, facts: dict[str, Any]) -> str:
    """Standard error of a fact, in the same line: of one pixel for a median over pixels, else of the number."""
    base = name.removesuffix("_e_per_count").removesuffix("_e")
    for ending in ERRORS:
        error = facts.get(f"{name}{ending}", facts.get(f"{base}{ending}"))
        if error is not None:
            text = "unknown" if error != error else f"{error:.2g}"
            return f" (standard error of a pixel {text})" if name.startswith("median") else f" +- {text}"
    return ""


def _newer(product: Path, source: Path) -> bool:
    return product.stat().st_mtime > source.stat().st_mtime
