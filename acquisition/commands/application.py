"""The `acquire` command: captures and campaigns on a rig, and the rig by hand."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from acquisition.commands import by_hand, custody_commands, demo
from acquisition.commands.defaults import INTERRUPTED, RigFile
from processing.commands.command_line import Version, application, printable

if TYPE_CHECKING:
    from acquisition.stop_request import StopRequest

app = application("acquire", "Take Mueller and Stokes captures.")

Omega = Annotated[float | None, typer.Option("--omega", help="angle between source and camera, degrees")]
ModeName = Annotated[str | None, typer.Option("--mode", help="drr (Mueller image) or stokes (one generator state)")]
Wavelength = Annotated[float | None, typer.Option("--wavelength", help="nm")]
PlanFile = Annotated[Path | None, typer.Option("--plan", help="plan file; options override it")]


@app.callback(invoke_without_command=True)
def capture(
    context: typer.Context,
    omega: Omega = None,
    mode: ModeName = None,
    wavelength: Wavelength = None,
    *,
    sample: Annotated[str | None, typer.Option(help="name of the sample; air and mirror are known samples")] = None,
    exposure: Annotated[float | None, typer.Option(help="seconds")] = None,
    rig: RigFile = None,
    plan: PlanFile = None,
    out: Annotated[Path, typer.Option(help="folder of the capture")] = Path("captures"),
    seed: Annotated[int | None, typer.Option(help="of the simulated noise")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="check everything, move nothing")] = False,
    home: Annotated[bool, typer.Option("--home", help="home axes that have no reference")] = False,
    campaign: Annotated[Path | None, typer.Option(help="campaign file: take its missing captures")] = None,
    resume: Annotated[Path | None, typer.Option(help="resume this partial capture")] = None,
    as_new: Annotated[
        bool, typer.Option("--as-new", help="start again in a new file if the existing one has another set-up")
    ] = False,
    live: Annotated[bool, typer.Option("--live", help="show the run on a local web page")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="answer every question with yes")] = False,
    version: Version = False,
) -> None:
    """Take a capture: `acquire --omega 35`."""
    if context.invoked_subcommand is not None:
        return
    if omega is None and plan is None and resume is None and campaign is None:
        sources = (context.get_parameter_source(name) for name in context.params)
        if any(source is not None and source.name == "COMMANDLINE" for source in sources):
            typer.echo(
                "error: nothing to measure: give --omega, --plan, --campaign or --resume (-h for help)", err=True
            )
        else:
            typer.echo(context.get_help())
        raise typer.Exit(2)
    from acquisition.commands import single

    options = single.Options(
        omega, mode, wavelength, sample, exposure, rig, plan, out, seed, dry_run, home, resume, as_new, live, yes
    )
    if campaign is None:
        raise typer.Exit(_stoppable(lambda stop: single.run(options, stop)))
    from acquisition.commands import campaign as campaign_command

    raise typer.Exit(_stoppable(lambda stop: campaign_command.run(options, campaign, stop)))


by_hand.register(app)
custody_commands.register(app)
demo.register(app)


def _stoppable(action: Callable[[StopRequest], int]) -> int:
    from acquisition.stop_request import StopRequest

    # Straight to the descriptor: the signal may come in the middle of a buffered write.
    with StopRequest(tell=lambda text: os.write(2, f"\n{text}\n".encode())) as stop:
        try:
            return action(stop)
        except KeyboardInterrupt as error:
            # Typer would end the program without a word.
            _report(error, INTERRUPTED, "stopped at once; every axis was sent a stop")


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `acquire`; ends in SystemExit.

    Exit codes: 0 done, 1 the run failed, 2 bad input, 130 interrupted.
    """
    from acquisition.errors import AcquisitionError, Differs, PlanRefused, Stopped, Unforeseen, as_run_error
    from drivers.errors import DeviceError
    from processing.errors import ProcessError

    _say_alarms()
    try:
        app(args=None if argv is None else list(argv))
    except (PlanRefused, Differs, ProcessError) as error:
        _report(error, 2)
    except Stopped as error:
        _report(error, INTERRUPTED)
    except (AcquisitionError, DeviceError, OSError) as error:
        _report(error, 1)
    except KeyboardInterrupt as error:
        _report(error, INTERRUPTED, "stopped at once; every axis was sent a stop")
    except Exception as error:  # noqa: BLE001 - the last boundary: a user reads a line, the traceback goes to a file
        failure = as_run_error(error)
        if isinstance(failure, Unforeseen):
            from acquisition.rig import alarms

            failure.add_note(alarms.keep("traceback", f"traceback-{os.getpid()}.txt", failure.trace))
        _report(failure, 1)


def _say_alarms() -> None:
    from acquisition.rig import alarms

    for alarm in alarms.unacknowledged():
        text = f"ALARM since {alarm.time}, rig {alarm.rig}: {alarm.text}. Acknowledge with: {alarms.ACKNOWLEDGE}"
        typer.echo(text, err=True)


def _report(error: BaseException, code: int, text: str | None = None) -> NoReturn:
    typer.echo(f"error: {printable(text or error)}", err=True)
    for note in getattr(error, "__notes__", []):
        typer.echo(printable(note), err=True)
    sys.exit(code)


if __name__ == "__main__":
    main()
