"""The figure that a command writes next to its product."""

from pathlib import Path
from typing import Annotated

import typer

#: Of figures that can be drawn.
ENDINGS = (".png", ".svg", ".pdf", ".jpg", ".tif", ".eps")


def _require_figure(figure: Path | None) -> Path | None:
    """The place for a figure is looked at before the work that it is to show. Raises ProcessError."""
    if figure is not None:
        from processing.doors import require_folder
        from processing.errors import ProcessError

        require_folder(figure)
        if figure.suffix.lower() not in ENDINGS:
            raise ProcessError(
                f"--figure {figure}: give a name that ends in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}."
            )
    return figure


FigureFile = Annotated[
    Path | None,
    typer.Option("--figure", help="Figure (PNG, SVG, PDF); default: beside the product.", callback=_require_figure),
]
NoFigure = Annotated[bool, typer.Option("--no-figure", help="Draw no figure.")]


def draw(product: Path, figure: Path | None, no_figure: bool, silent: bool = False) -> None:
    """Draw a product and print where, unless `silent`; nothing with `no_figure`."""
    if no_figure:
        return
    from processing.reports.figures import draw_product

    figure = figure or product.with_suffix(".png")
    draw_product(product, figure)
    if not silent:
        typer.echo(f"figure: {figure}")
