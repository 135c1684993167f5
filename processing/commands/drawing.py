"""The figure that a command leaves beside its product."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

FigureFile = Annotated[
    Path | None, typer.Option("--figure", help="Figure (PNG, SVG, PDF); default: beside the product.")
]
NoFigure = Annotated[bool, typer.Option("--no-figure", help="Draw no figure.")]


def draw(product: Path, figure: Path | None, no_figure: bool) -> None:
    """Draw a product and say where; nothing with `no_figure`."""
    if no_figure:
        return
    from processing.reports.figures import draw_product

    figure = figure or product.with_suffix(".png")
    draw_product(product, figure)
    typer.echo(f"figure: {figure}")
