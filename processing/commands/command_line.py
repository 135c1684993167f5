"""What the four commands share: their look, `--version`, and errors of the user as one message, never a traceback."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated

import typer

from processing.errors import ProcessError

INTERRUPTED = 130


def _tell_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"umov {version('umov')}")
        raise typer.Exit()


#: The option `--version` of an application's callback or only command.
Version = Annotated[
    bool, typer.Option("--version", help="print the version and stop", callback=_tell_version, is_eager=True)
]


def application(name: str, text: str) -> typer.Typer:
    """An application with the look that all four share: plain help, also by -h, and shell completion."""
    return typer.Typer(
        name=name,
        help=text,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )


def run(app: typer.Typer, argv: Sequence[str] | None = None) -> None:
    """Run `app` on `argv` (default: the process's own arguments); always ends in SystemExit.

    Exit codes: 0 done, 1 the run failed, 2 bad input, 130 interrupted.
    """
    try:
        app(args=None if argv is None else list(argv))
    except ProcessError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(error.exit_code)
    except FileNotFoundError as error:
        typer.echo(f"error: {error.filename}: no such file or folder", err=True)
        sys.exit(2)
    except OSError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(1)
    except KeyboardInterrupt:
        typer.echo("interrupted; nothing that was finished is lost", err=True)
        sys.exit(INTERRUPTED)
