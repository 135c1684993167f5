"""Run a typer application: errors of the user become one message and an exit code, never a traceback."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import typer

from processing.errors import ProcessError

INTERRUPTED = 130


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
