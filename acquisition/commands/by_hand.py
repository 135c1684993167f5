"""The rig by hand: `acquire init`, `doctor`, `home`, `move`, `stop`, `snap` and `acknowledge`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquisition.commands.defaults import DEFAULT_RIG, RigFile

if TYPE_CHECKING:
    from acquisition.rig.config import RigConfig


def register(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (init, doctor, home, stop, snap, acknowledge):
        app.command()(command)
    # So that -30 is an angle and not an option.
    app.command(context_settings={"ignore_unknown_options": True})(move)


def init(
    out: Annotated[Path, typer.Option(help="rig file to write; an existing one is kept")] = Path("rig.yaml"),
    micromanager: Annotated[Path | None, typer.Option(help="configuration of Micro-Manager to list")] = None,
) -> None:
    """Write a rig file to begin with, from the cameras and serial ports that are there; opens no port."""
    from acquisition.commands.init import write_rig

    typer.echo(write_rig(out, micromanager))


def doctor(
    rig: RigFile = None,
    out: Annotated[Path, typer.Option(help="folder of captures")] = Path(),
    frames: Annotated[int, typer.Option(min=1, help="of the packet-loss test")] = 50,
) -> None:
    """Tell what is there and what is wrong; moves nothing. Exit code 1 if anything is wrong."""
    from rich.console import Console
    from rich.markup import escape

    from acquisition.commands.doctor import examine
    from acquisition.screen.rows import print_rows
    from acquisition.stop_request import StopRequest
    from processing.commands.command_line import printable

    config = _load(rig)
    findings = []
    with StopRequest(patience=1), Console(stderr=True).status("looking at the rig") as status:
        for finding in examine(config, out, frames):
            findings.append(finding)
            status.update(f"looking at the rig: {escape(printable(finding.title))} done")
    print_rows(finding.row for finding in findings)
    if faults := [finding.title for finding in findings if finding.well is False]:
        typer.echo(f"not as it should be: {', '.join(faults)}", err=True)
        raise typer.Exit(1)


def home(
    axes: Annotated[list[str] | None, typer.Argument(help="axes; without any, all that have no reference")] = None,
    rig: RigFile = None,
    yes: Annotated[bool, typer.Option("--yes", help="the way is free: do not ask")] = False,
) -> None:
    """Home axes, one after another. They turn to their reference switches: look that the way is free."""
    from rich.console import Console

    from acquisition.rig.open_rig import open_rig
    from acquisition.stop_request import StopRequest

    config = _load(rig)
    _require_axes(config, axes or [])
    with StopRequest(patience=1), open_rig(config, with_camera=False) as live:
        unhomed = live.unhomed()
        names = [name for name in live.homing_order() if name in (axes or unhomed)]
        if not names:
            typer.echo("every axis has its reference; name an axis to home it again")
            return
        typer.echo(f"these will turn to their reference switches, in this order: {', '.join(names)}")
        _require_consent(config, yes)
        for name in names:
            with Console(stderr=True).status(f"homing {name}; Ctrl-C stops it"):
                live.home([name])
            typer.echo(f"{name} is homed, at {live.axes[name].read_position().deg:.4f} deg")
    _say_ended(config)


def _require_consent(config: RigConfig, yes: bool) -> None:
    """Ask whether the way is free; emulators have nothing to hit."""
    from acquisition.errors import Stopped

    if yes or config.simulated:
        return
    if not sys.stdin.isatty():
        raise Stopped("nobody confirmed that the way is free; nothing was moved. Use a terminal, or --yes")
    if not typer.confirm("Is their way free?"):
        raise Stopped("the way is not free; nothing was moved")


def move(
    axis: Annotated[str, typer.Argument(help="axis of the rig file")],
    degrees: Annotated[float, typer.Argument(help="absolute angle; of a liquid crystal volts")],
    rig: RigFile = None,
    home_first: Annotated[bool, typer.Option("--home", help="home the axis if it has no reference")] = False,
) -> None:
    """Move one axis to an absolute angle."""
    from rich.console import Console

    from acquisition.rig.open_rig import open_rig
    from acquisition.stop_request import StopRequest

    config = _load(rig)
    _require_axes(config, [axis])
    with (
        StopRequest(patience=1),
        open_rig(config, with_camera=False) as live,
        Console(stderr=True).status("") as status,
    ):
        live.axes[axis].check(degrees)
        unit = live.axes[axis].config.unit
        if (home_first or config.home_at_start) and axis in live.unhomed():
            status.update(f"homing {axis}; Ctrl-C stops it")
            live.home([axis])
        status.update(f"moving {axis} to {degrees:g} {unit}; Ctrl-C stops it")
        typer.echo(f"{axis} at {live.move({axis: degrees})[axis].deg:.4f} {unit}")
    _say_ended(config)


def stop(rig: RigFile = None) -> None:
    """Stop every axis, and an acquire that measures on this rig, as Ctrl-C twice would."""
    from acquisition.rig.config import has_own_emulators, load_rig
    from acquisition.rig.stop_axes import stop_axes

    # Not noted as the user's own: a home folder on a disc that hangs must not delay the stop.
    config = load_rig(rig or DEFAULT_RIG)
    if has_own_emulators(config):
        typer.echo("the axes of this rig are emulators inside the command that uses it: press Ctrl-C twice there")
    elif not stop_axes(config, typer.echo):
        raise typer.Exit(1)


def snap(
    exposure: Annotated[float, typer.Option(min=1e-6, help="seconds")] = 0.02,
    out: Annotated[Path, typer.Option(help=".png (8 bits, stretched), .tif or .npy (counts)")] = Path("snap.png"),
    rig: RigFile = None,
    light: Annotated[bool, typer.Option("--light/--dark", help="let light through for it")] = True,
    *,
    wavelength: Annotated[float | None, typer.Option(help="nm, for a source that selects it")] = None,
    sample: Annotated[str, typer.Option(help="what the simulated rig shows")] = "red_sphere",
) -> None:
    """Take one frame as things stand; moves nothing, and leaves light on or off as it was found."""
    from acquisition.commands.snap import take_frame
    from acquisition.stop_request import StopRequest

    config = _load(rig)
    with StopRequest(patience=1):
        typer.echo(take_frame(config, exposure, out, light, sample=sample, wavelength_nm=wavelength))


def acknowledge() -> None:
    """End the alarms that the guard repeats, once somebody has looked at the rig."""
    from acquisition.rig import alarms

    pending = alarms.unacknowledged()
    for alarm in pending:
        typer.echo(f"{alarm.time}, rig {alarm.rig}: {alarm.text}")
        alarms.acknowledge(alarm)
    typer.echo(f"{len(pending)} acknowledged" if pending else "there is no alarm")


def _load(rig: Path | None) -> RigConfig:
    from rich.console import Console

    from acquisition.commands.single import load_user_rig, say_simulated

    config = load_user_rig(rig or DEFAULT_RIG)
    say_simulated(Console(stderr=True), config)
    return config


def _say_ended(config: RigConfig) -> None:
    from acquisition.rig.config import has_own_emulators

    if has_own_emulators(config):
        typer.echo("the emulators of this rig end with this command: the next one finds them as they were at first")


def _require_axes(config: RigConfig, names: list[str]) -> list[str]:
    from processing.yaml_file import ConfigError

    for name in names:
        if name not in config.axes:
            raise ConfigError(f"axis {name!r}: the rig has {', '.join(config.axes)}")
    return names
