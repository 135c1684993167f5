"""`process quantities`: all derived maps of a Mueller image, with standard errors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from processing.commands.batch import captures_and, files_of, make_products
from processing.commands.command_line import IMAGES, Overwrite, ProductFile, command
from processing.commands.drawing import FigureFile, NoFigure

if TYPE_CHECKING:
    from processing.polarization.quantities import NamedStokes
    from processing.steps.file_step import FileStep, Progress, StepProduct


@command("quantities", IMAGES)
def quantities_command(
    *,
    sources: Annotated[
        list[Path], typer.Argument(help="Captures or Mueller products of `process reduce`, or folders of them.")
    ],
    also: Annotated[list[str] | None, typer.Option(help="More decompositions: symmetric, differential.")] = None,
    pair: Annotated[
        list[str] | None,
        typer.Option(
            help="GENERATOR,ANALYZER: light between two polarizers, e.g. 45,right, beside the three of the bunny."
        ),
    ] = None,
    instrument: Annotated[Path | None, typer.Option(help="Instrument file, where a capture is reduced here.")] = None,
    out: ProductFile = None,
    figure: FigureFile = None,
    no_figure: NoFigure = False,
    overwrite: Overwrite = False,
) -> None:
    """Eigenvalues, depolarization, diattenuation, polarizance, retardance and their standard errors."""
    from processing.maps.quantities import require_decompositions
    from processing.polarization.quantities import PAPER_PAIRS
    from processing.steps.maps import Quantities
    from processing.steps.reduction import reduce_or_open

    pairs = {**PAPER_PAIRS, **dict(_pair(text) for text in pair or ())}
    # Before a capture is reduced for nothing.
    require_decompositions(also or ())

    def step_of(source: Path, tick: Progress) -> tuple[FileStep, StepProduct | None]:
        image = reduce_or_open(source, instrument, tick)
        return Quantities(image.path, tuple(also or ()), pairs), image if image.path != source else None

    inputs = files_of(sources, captures_and(("mueller", "extrapolated")), "Mueller captures")
    make_products(
        "quantities", "rows", inputs, step_of, out=out, overwrite=overwrite, figure=figure, no_figure=no_figure
    )


def _pair(text: str) -> tuple[str, tuple[NamedStokes, NamedStokes]]:
    from processing.errors import ProcessError
    from processing.polarization.quantities import POLARIZATIONS

    names = [part.strip() for part in text.split(",")]
    if len(names) != 2 or not set(names) <= set(POLARIZATIONS):
        raise ProcessError(f"--pair {text!r}: give GENERATOR,ANALYZER, each one of: {', '.join(POLARIZATIONS)}")
    generator, analyzer = (cast("NamedStokes", name) for name in names)
    return f"{generator}_to_{analyzer}", (generator, analyzer)
