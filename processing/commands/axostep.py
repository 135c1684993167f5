"""`process from-axostep` and `to-axostep`: Mueller images of RGB950's own program, in and out."""

from pathlib import Path
from typing import Annotated

import typer

from processing.commands.batch import Output, files_of, place_for, run_batch, write_if_changed
from processing.commands.command_line import DATA, EXPORT, Overwrite, ProductFile, command


@command("from-axostep", DATA)
def from_axostep_command(
    *,
    sources: Annotated[
        list[Path],
        typer.Argument(
            help="Files .cmmi or .bmmi, or folders of them. Raw .rmmd files go to `process import --stack`."
        ),
    ],
    wavelength_nm: Annotated[float | None, typer.Option(help="Where the file does not say.")] = None,
    omega_deg: Annotated[float | None, typer.Option(help="Angle of the source arm.")] = None,
    out: ProductFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Make Mueller products out of calibrated AxoStep images. They have no standard errors: the files hold none."""
    from processing.storage.formats.axostep_product import product_of_axostep

    inputs = files_of(sources, lambda path: True, "AxoStep images", (".cmmi", ".bmmi"))
    place = place_for(inputs, out)

    def make(source: Path, _: object) -> Output:
        target = place(source.with_suffix(".mueller.h5"))
        facts, is_unchanged = product_of_axostep(source, target, wavelength_nm, omega_deg, overwrite=overwrite)
        return Output((target,), is_unchanged, "".join(f"  {fact}" for fact in facts))

    def print_result(output: Output) -> None:
        typer.echo(f"{output.facts.strip()}\n{output.paths[0]}")

    run_batch("reading", "files", inputs, make, print_result=print_result)


@command("to-axostep", EXPORT)
def to_axostep_command(
    sources: Annotated[list[Path], typer.Argument(help="Mueller products of `process reduce`, or folders of them.")],
    out: Annotated[
        Path | None, typer.Option(help="File .cmmi or .bmmi, or a folder; default: .bmmi beside the source.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file of that name.")] = False,
) -> None:
    """Write Mueller products in AxoStep's format, for the lab's own tools."""
    from processing.storage.formats.axostep_product import axostep_of_product
    from processing.storage.products.product import Product, is_product

    def is_mueller(path: Path) -> bool:
        if not is_product(path):
            return False
        with Product(path) as product:
            return product.kind == "mueller"

    inputs = files_of(sources, is_mueller, "Mueller products")
    place = place_for(inputs, out)

    def make(source: Path, _: object) -> Output:
        target = place(source.with_suffix("").with_suffix(".bmmi"))

        def write(name: Path) -> list[Path]:
            axostep_of_product(source, name, overwrite)
            return [name]

        return write_if_changed(target, overwrite, write)

    run_batch("writing", "files", inputs, make)
