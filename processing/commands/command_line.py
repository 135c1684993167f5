"""Common parts of the five commands: their look, `--version`, and user errors as one message without a traceback."""

import atexit
import gc
import os
import sys
from collections.abc import Callable, Sequence
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

import typer
from typer.core import TyperGroup
from typer.exceptions import TyperException

from processing.doors import CONTROL
from processing.errors import ProcessError

INTERRUPTED = 130
# Headings of `process --help`: purposes of its commands, in the order of the work.
DATA = "Bring data in"
IMAGES = "Images and quantities"
CALIBRATION = "Calibrate and design"
REFLECTANCE = "Reflectance"
REPORTS = "Campaigns and reports"
EXPORT = "Write for other programs"
#: Commands that come first in their list, as they are used; the others follow by name.
FIRST = ("init", "import", "reduce", "quantities", "mean", "check", "calibrate", "fit-material", "campaign", "export")
#: In this order.
PURPOSES = (DATA, IMAGES, CALIBRATION, REFLECTANCE, REPORTS, EXPORT)
#: Options of the commands that write a product.
ProductFile = Annotated[Path | None, typer.Option("--out", help="Product file; default: beside the input.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a product of that name.")]
# Two things that everybody would wait for. None of pydantic's plug-ins is used: looking for them reads the metadata of
# all packages. Before it ends, the interpreter would look for cycles in all that the libraries keep.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")
atexit.register(gc.freeze)


def printable(text: object) -> str:
    """Text as a terminal may get it: control characters of file names and devices as escapes, lines as they are."""
    return CONTROL.sub(lambda match: match[0] if match[0] in "\n\t" else ascii(match[0])[1:-1], str(text))


def _tell_version(is_requested: bool) -> None:
    if is_requested:
        typer.echo(f"umov {version('umov')}")
        raise typer.Exit()


#: The option `--version` of an application's callback or only command.
Version = Annotated[
    bool, typer.Option("--version", help="print the version and stop", callback=_tell_version, is_eager=True)
]


#: What `command` has marked: name, heading of the help, function.
COLLECTED: list[tuple[str, str, Callable[..., None]]] = []
F = TypeVar("F", bound=Callable[..., None])


def command(name: str, purpose: str) -> Callable[[F], F]:
    """Make a command of `process` of a function, under a heading of its help."""

    def keep(function: F) -> F:
        COLLECTED.append((name, purpose, function))
        return function

    return keep


class Commands(TyperGroup):
    """Commands whose help lists them by purpose (`rich_help_panel`), each with its whole first sentence."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a list a purpose, and last those that name none."""
        shown = {name: command for name, command in self.commands.items() if not command.hidden}
        purposes = {getattr(command, "rich_help_panel", None) or "Commands" for command in shown.values()}
        widest = max(map(len, shown), default=0)
        for purpose in sorted(purposes, key=(*PURPOSES, "Commands").index):
            rows = [
                # Padded: the summaries of all lists begin in one column.
                (name.ljust(widest), command.get_short_help_str(limit=1000))
                for name, command in sorted(shown.items(), key=lambda item: _rank(item[0]))
                if (getattr(command, "rich_help_panel", None) or "Commands") == purpose
            ]
            with formatter.section(purpose):
                formatter.write_dl(rows)


def _rank(name: str) -> tuple[int, str]:
    return (FIRST.index(name) if name in FIRST else len(FIRST), name)


class Application(typer.Typer):
    """Commands that tell a mistake of usage as every other one: what was given, and what is wanted."""

    @cached_property
    def _command(self) -> Any:
        # Its options are read from the signatures of all functions, which takes as long as many a command.
        return typer.main.get_command(self)

    def __call__(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Run on the process's own arguments, or on `args`; always ends in SystemExit."""
        try:
            ended = self._command(*args, standalone_mode=False, **kwargs)
        except TyperException as error:
            typer.echo(_error_text(error), err=True)
            sys.exit(error.exit_code)
        sys.exit(ended if isinstance(ended, int) else 0)


def _error_text(error: TyperException) -> str:
    text, context = error.format_message().rstrip("."), getattr(error, "ctx", None)
    if text.startswith("Usage:"):
        # A command without arguments: its help is the answer.
        return text
    parameter, cause = getattr(error, "param", None), error.__cause__
    if parameter is not None and isinstance(cause, ValueError) and hasattr(cause, "errors"):
        wrong = cause.errors()[0]
        name = parameter.opts[0] if parameter.opts else parameter.name
        expected = wrong["msg"].removeprefix("Input should be ").partition(", unable")[0]
        explained = f" ({parameter.help})" if getattr(parameter, "help", None) else ""
        text = f"{name} {wrong['input']}: must be {expected}{explained}"
    if context is None:
        return f"error: {text}"
    # As the user started this program: `UMOV_DOOR` is set by ./lab.
    words = context.command_path.split()
    if words[0] == "umov":
        words[0] = os.environ.get("UMOV_DOOR", "umov")
    end = "" if text.endswith("?") else "."
    return f"error: {text}{end} More: {' '.join(words)} -h"


def application(name: str, text: str) -> Application:
    """An application with the look that all five share: plain help, also by -h, and shell completion."""
    return Application(
        name=name,
        cls=Commands,
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
        typer.echo(f"error: {printable(error)}", err=True)
        sys.exit(error.exit_code)
    except FileNotFoundError as error:
        typer.echo(f"error: {printable(error.filename)}: no such file or folder", err=True)
        sys.exit(2)
    except OSError as error:
        typer.echo(f"error: {printable(error)}", err=True)
        sys.exit(1)
    except SystemExit as ended:
        # Typer turns Ctrl-C into this exit code, without a word.
        if ended.code == INTERRUPTED:
            typer.echo("interrupted; nothing that was finished is lost", err=True)
        raise
