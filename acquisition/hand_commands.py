"""The rig by hand: `acquire doctor`, `home`, `move`, `stop` and `snap`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from acquisition.rig_config import RigConfig

RigFile = Annotated[Path | None, typer.Option("--rig", help="rig file; without it the SIMULATED rig")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (doctor, home, move, stop, snap):
        app.command()(command)


def doctor(rig: RigFile = None, out: Annotated[Path, typer.Option(help="folder of captures")] = Path()) -> None:
    """Tell what is there and what is wrong; moves nothing."""
    from acquisition.doctor import examine

    failures = 0
    for finding in examine(_load(rig), out):
        mark = {True: "ok  ", False: "BAD ", None: "    "}[finding.well]
        typer.echo(f"{mark} {finding.what:<12} {finding.found}")
        failures += finding.well is False
    if failures:
        typer.echo(f"{failures} things are not as they should be", err=True)
        raise typer.Exit(1)


def home(
    axes: Annotated[list[str] | None, typer.Argument(help="axes; without any, all that have no reference")] = None,
    rig: RigFile = None,
) -> None:
    """Home axes. They turn to their reference switch: look that the way is free."""
    from acquisition.rig import Rig

    with Rig(_load(rig), with_camera=False) as live:
        names = _known(live.config, axes) if axes else live.unhomed()
        if not names:
            typer.echo("every axis has its reference; name an axis to home it again")
        for name in names:
            typer.echo(f"homing {name}")
            live.home([name])
            typer.echo(f"{name} at {live.axes[name].read_position().deg:.4f} deg")


def move(
    axis: Annotated[str, typer.Argument(help="axis of the rig file")],
    degrees: Annotated[float, typer.Argument(help="absolute angle; write -- before a negative one")],
    rig: RigFile = None,
    home_first: Annotated[bool, typer.Option("--home", help="home the axis if it has no reference")] = False,
) -> None:
    """Move one axis to an absolute angle."""
    from acquisition.rig import Rig
    from acquisition.stop_request import StopRequest

    with StopRequest(patience=1), Rig(_load(rig), with_camera=False) as live:
        _known(live.config, [axis])
        live.axes[axis].check(degrees)
        if (home_first or live.config.home_at_start) and axis in live.unhomed():
            live.home([axis])
        typer.echo(f"{axis} at {live.move({axis: degrees})[axis].deg:.4f} deg")


def stop(rig: RigFile = None) -> None:
    """Stop every axis. A measurement that runs holds the ports: press Ctrl-C twice there instead."""
    from acquisition.rig import Rig

    with Rig(_load(rig), with_camera=False) as live:
        failure = live.stop()
        if failure is not None:
            raise failure
        for name, axis in live.axes.items():
            note = "" if axis.can_stop_a_move else " (this kind runs a started move to its end)"
            typer.echo(f"{name}: stop sent{note}")


def snap(
    exposure: Annotated[float, typer.Option(min=1e-6, help="seconds")] = 0.02,
    out: Annotated[Path, typer.Option(help="PNG (8 bits, stretched) or TIFF (counts)")] = Path("snap.png"),
    rig: RigFile = None,
    light: Annotated[bool, typer.Option("--light/--dark", help="open the shutter for it")] = True,
    sample: Annotated[str, typer.Option(help="what the simulated rig shows")] = "red_sphere",
) -> None:
    """Take one frame as things stand; moves nothing."""
    from acquisition.snap import take_frame

    typer.echo(take_frame(_load(rig), exposure, out, light, sample))


def _load(rig: Path | None) -> RigConfig:
    from rich.console import Console

    from acquisition.cli import DEFAULT_RIG
    from acquisition.rig_config import load_rig
    from acquisition.single import say_simulated

    config = load_rig(rig or DEFAULT_RIG)
    say_simulated(Console(stderr=True), config)
    return config


def _known(config: RigConfig, names: list[str]) -> list[str]:
    from processing.yaml_file import ConfigError

    for name in names:
        if name not in config.axes:
            raise ConfigError(f"axis {name!r}: the rig has {', '.join(config.axes)}")
    return names
