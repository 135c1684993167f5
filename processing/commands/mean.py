"""`process mean`: mean and uncertainty of a region, of repeats, of the captures of a night."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from processing.commands.batch import captures_and, files_of
from processing.commands.command_line import IMAGES, command

if TYPE_CHECKING:
    from processing.maps.means import MeanValue


@command("mean", IMAGES)
def mean_command(
    *,
    sources: Annotated[list[Path], typer.Argument(help="Captures or products of one sample, or folders of them.")],
    region: Annotated[
        str | None, typer.Option(help="Pixels to average: r0:r1,c0:c1; default: the middle half of the frame.")
    ] = None,
    budget: Annotated[
        str | None, typer.Option(help="Quantity whose uncertainty budget (GUM) is printed, e.g. depolarization_index.")
    ] = None,
    instrument: Annotated[Path | None, typer.Option(help="Instrument file to reduce captures with.")] = None,
    out: Annotated[Path | None, typer.Option(help="New file with all means: .csv or .json.")] = None,
) -> None:
    """Mean M or S of a region and of several captures, and every quantity of that mean, with all uncertainties.

    "u noise" gets smaller with more pixels and captures, "u instrument" does not.
    """
    from processing.commands.progress_bar import progress_bar
    from processing.doors import require_distinct, require_new
    from processing.errors import ProcessError
    from processing.export.means_file import write_means
    from processing.maps.means import mean_of
    from processing.maps.region import parse_region
    from processing.steps.reduction import reduce_or_open
    from processing.storage.products.product import Product

    if out is not None:
        require_new(out)
        if out.suffix not in (".csv", ".json"):
            raise ProcessError(f"--out {out}: means are written as .csv or .json. Choose one of these endings.")
    inputs = files_of(sources, captures_and(("mueller", "stokes")), "captures")
    require_distinct(inputs)
    products = []
    with progress_bar("reducing", "rows") as tick:
        for path in inputs:
            products.append(reduce_or_open(path, instrument, tick).path)
    places, simulated = [], False
    for path in products:
        with Product(path) as product:
            places.append(parse_region(region, product.shape))
            simulated |= product.simulated
    if any(place != places[0] for place in places):
        raise ProcessError("the captures have frames of several sizes. Name the pixels: --region r0:r1,c0:c1")
    rows, columns = places[0]
    means = mean_of(products, places[0])
    place = f"rows {rows.start}:{rows.stop}, columns {columns.start}:{columns.stop}"
    captures = f"{len(products)} capture{'s' if len(products) > 1 else ''}"
    if simulated:
        typer.echo("SIMULATED data")
    typer.echo(f"mean of {place} of {captures}; intervals of 95 %")
    if all(len(mean.budget) == 1 for mean in means):
        typer.echo(
            "warning: the instrument file states no uncertainty, so the intervals contain none. Write values as "
            "{value: ..., u: ...}, or run: process calibrate AIR.h5 --instrument FILE --free NAMES --write NEW.yaml",
            err=True,
        )
    if budget is None:
        _print_means(means)
    else:
        _print_budget(means, budget)
    if out is not None:
        facts = {"captures": ", ".join(path.name for path in inputs), "pixels": place, "simulated": simulated}
        write_means(out, means, facts)
        typer.echo(str(out))


def _print_means(means: Sequence[MeanValue]) -> None:
    head = ("quantity", "value", "u noise", "u instrument", "scatter", "dof", "interval")
    typer.echo("{:38} {:>11} {:>9} {:>12} {:>9} {:>6}  {}".format(*head))
    for mean in means:
        typer.echo(
            f"{mean.name:38} {mean.value:11.5g} {mean.u_noise:9.2g} {mean.u_systematic:12.2g} {mean.scatter:9.2g} "
            f"{mean.degrees_of_freedom:6.3g}  {mean.low:.5g} to {mean.high:.5g} {mean.unit}"
        )


def _print_budget(means: Sequence[MeanValue], name: str) -> None:
    from processing.errors import ProcessError
    from processing.maps.means import BUDGET_COLUMNS

    mean = next((value for value in means if value.name == name), None)
    if mean is None:
        raise ProcessError(f"--budget {name}: no such quantity. Choose one of: {', '.join(v.name for v in means)}")
    typer.echo(f"{mean.name} = {mean.value:.6g} {mean.unit}")
    for line in (BUDGET_COLUMNS, *mean.budget_lines):
        typer.echo("  {:50} {:>9} {:>11} {:>12} {:>7} {:>5}".format(*line))
    typer.echo(f"  {mean.interval_text}")
