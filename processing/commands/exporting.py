"""`process export`: captures, products and tables in the formats of other programs."""

from pathlib import Path
from typing import Annotated

import typer

from processing.commands.batch import Output, files_of, place_for, run_batch, write_if_changed
from processing.commands.command_line import EXPORT, command


@command("export", EXPORT)
def export_command(
    *,
    sources: Annotated[
        list[Path], typer.Argument(help="Captures, products, tables of `process table`, or folders of the last two.")
    ],
    to: Annotated[str, typer.Option(help="tiff, csv, fits, mat, png or pdf.")],
    plane: Annotated[list[str] | None, typer.Option(help="Plane, may be repeated; default: all.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="File, without or with its ending, or a folder; default: by the source.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files of that name.")] = False,
) -> None:
    """Write captures or products as TIFF stacks, CSV, FITS, MATLAB or as figures for a paper; tables as CSV."""
    from processing.export import export
    from processing.export.figure import FIGURES
    from processing.reflectance.tables import is_table
    from processing.storage.products.product import Product, is_product

    def takes(path: Path) -> bool:
        if not is_product(path):
            return to not in FIGURES and is_table(path)
        with Product(path) as product:
            return set(plane or ()) <= set(product.names)

    inputs = files_of(sources, takes, f"products with {', '.join(plane)}" if plane else "products")
    place = place_for(inputs, out)

    def make(source: Path, _: object) -> Output:
        target = place(source.with_suffix(""))
        return write_if_changed(target, overwrite, lambda name: export(source, to, name, plane or ()))

    run_batch("exporting", "files", inputs, make)
