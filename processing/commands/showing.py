"""`process show`: what the values of an instrument file do."""

from pathlib import Path
from typing import Annotated

import typer

from processing.commands.command_line import REPORTS, command


@command("show", REPORTS)
def show_command(
    instrument: Annotated[Path, typer.Argument(help="Instrument file, as `diagnose --write` makes it.")],
    wavelength_nm: Annotated[
        float | None, typer.Option(help="Wavelength at which the change of M is taken; default: each value's own.")
    ] = None,
) -> None:
    """List what `diagnose` found: values, standard errors, the captures they hold for, and their change of M."""
    from processing.instrument.influence import influences
    from processing.instrument.model import InstrumentModel

    model = InstrumentModel.load(instrument)
    effects = influences(model, wavelength_nm)
    if not effects:
        typer.echo(f"{instrument}: no value of `diagnose`. Write some: diagnose CAPTURE --write NEW.yaml")
    for influence in effects:
        change = "its change of M depends on the capture"
        if influence.change is not None:
            size = "one standard error" if influence.fitted else "it"
            change = f"{size} changes M/m00 of air by {influence.change:.2g} rms"
        typer.echo(f"{influence.name}: {influence.value}")
        typer.echo(f"  holds for {influence.scope}; {change}")
    for error in model.systematic:
        typer.echo(f"still uncertain: M/m00 by {error.rms_over_m00:.2g} rms, in {len(error.directions)} directions")
