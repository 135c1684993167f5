"""`process from-axostep` and `to-axostep`: Mueller images of RGB950's own program, in and out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from processing.commands.product_options import Overwrite, ProductFile


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("from-axostep")(from_axostep_command)
    app.command("to-axostep")(to_axostep_command)


def from_axostep_command(
    source: Annotated[
        Path, typer.Argument(help="File .cmmi or .bmmi. Raw .rmmd files go to `process import --stack`.")
    ],
    wavelength_nm: Annotated[float | None, typer.Option(help="Where the file does not say.")] = None,
    omega_deg: Annotated[float | None, typer.Option(help="Angle of the source arm.")] = None,
    out: ProductFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Make a Mueller product out of a calibrated AxoStep image. It has no standard errors: the file holds none."""
    from processing.storage.axostep_product import product_of_axostep

    target = out or source.with_suffix(".mueller.h5")
    told = product_of_axostep(source, target, wavelength_nm, omega_deg, overwrite)
    for line in told:
        typer.echo(line)
    typer.echo(str(target))


def to_axostep_command(
    source: Annotated[Path, typer.Argument(help="Mueller product of `process reduce`.")],
    out: Annotated[Path | None, typer.Option(help="File .cmmi or .bmmi; default: .bmmi beside the source.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file of that name.")] = False,
) -> None:
    """Write a Mueller product in AxoStep's format, for the lab's own tools."""
    from processing.storage.axostep_product import axostep_of_product

    target = out or source.with_suffix("").with_suffix(".bmmi")
    axostep_of_product(source, target, overwrite)
    typer.echo(str(target))
