"""The `simulate` command: emulated controllers behind a pseudo-terminal, for any serial client."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from processing.commands.command_line import Version, application

app = application("simulate", "Emulated hardware that speaks the real bytes.")


@app.callback(no_args_is_help=True)
def _simulate(version: Version = False) -> None:
    """Emulated hardware: one controller, or a whole rig."""


@app.command()
def serve(
    kind: Annotated[str, typer.Argument(help="elliptec, zaber, apt-k10cr1, apt-kdc101, smc100, esp301 and others")],
    model: Annotated[str | None, typer.Option(help="model that it says it is")] = None,
    axes: Annotated[int | None, typer.Option(min=1, max=16, help="number of devices, modules or axes")] = None,
    limits: Annotated[str | None, typer.Option(help="travel of every axis as MIN:MAX in degrees")] = None,
    *,
    speed: Annotated[float, typer.Option(min=1e-3, help="deg/s")] = 300.0,
    acceleration: Annotated[float, typer.Option(min=1e-3, help="deg/s^2")] = 1500.0,
    homed: Annotated[bool, typer.Option("--homed", help="start with a reference, at angle zero")] = False,
    clock_speed: Annotated[float, typer.Option(min=1e-3, help="simulated seconds in a real second")] = 1.0,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="silent, stuck, slow, garbled, late, foreign, not_homed, slip or jammed; repeatable. garbled@12x1 "
            "spoils one reply from the 12th command on, slow@3.5s:0.2 slows to a fifth after 3.5 s, late:0.4 delays "
            "by 0.4 s"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="of the garbled bytes")] = 0,
) -> None:
    """Serve an emulated controller until SIGTERM; the first line of output is the path of its port."""
    from simulators.clock import FastClock
    from simulators.rig.controller_kinds import served_kinds
    from simulators.serial.reply_faults import FaultSchedule, parse_fault
    from simulators.serial.serve_options import ServeOptions
    from simulators.serial.tcp_port import port_for

    kinds = served_kinds()
    if kind not in kinds:
        raise typer.BadParameter(f"no controller {kind!r}; there are {', '.join(kinds)}", param_hint="KIND")
    try:
        faults = [parse_fault(text) for text in fault or []]
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--fault") from error
    options = ServeOptions(
        model=model,
        axes=axes,
        limits_deg=_parse_limits(limits),
        speed_deg_s=speed,
        acceleration_deg_s2=acceleration,
        homed=homed,
        clock=FastClock(clock_speed),
        faults=FaultSchedule(faults, seed),
    )
    try:
        emulator = kinds[kind](options)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    with _stop_event() as stop, port_for(emulator) as port:
        typer.echo(port.path)
        sys.stdout.flush()
        while not stop.wait(0.2) and port.is_serving():
            pass


@app.command()
def rig(
    rig_file: Annotated[Path, typer.Argument(help="rig file with a `simulator` section")],
    out: Annotated[Path, typer.Option(help="rig file to write, with device paths in place of sim: ports")],
    sample: Annotated[str, typer.Option(help="what stands at the centre")] = "red_sphere",
    mode: Annotated[str, typer.Option(help="drr or stokes")] = "drr",
    *,
    wavelength: Annotated[float, typer.Option(help="nm")] = 662,
    omega: Annotated[float, typer.Option(help="arm angle to prepare for, degrees")] = 35,
) -> None:
    """Serve a whole simulated rig until SIGTERM; any program can open its ports with the rig file written."""
    from drivers.errors import DeviceError
    from processing.errors import ProcessError
    from simulators.rig import served_rig

    try:
        with (
            _stop_event() as stop,
            served_rig.serve(rig_file, out, sample, mode, wavelength_nm=wavelength, omega_deg=omega),
        ):
            typer.echo(out)
            sys.stdout.flush()
            stop.wait()
    except (ProcessError, DeviceError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from None


@contextmanager
def _stop_event() -> Iterator[threading.Event]:
    """An event that SIGTERM and Ctrl-C set; afterwards they do what they did before."""
    event = threading.Event()
    before = {number: signal.signal(number, lambda *_: event.set()) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _parse_limits(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is not MIN:MAX in degrees", param_hint="--limits") from error
    if low >= high:
        raise typer.BadParameter(f"{text!r}: the lower limit comes first", param_hint="--limits")
    return low, high


def main() -> None:
    """Run the command line."""
    app()


if __name__ == "__main__":
    main()
