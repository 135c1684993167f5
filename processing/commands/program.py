"""The program `umov`: all commands under one name, `umov acquire`, `umov process reduce`, ..."""

import os
import sys
from collections.abc import Sequence
from importlib.metadata import distribution

import typer

from processing.commands.command_line import INTERRUPTED

#: Entry points of the distribution that are commands of `umov`.
GROUP = "umov.commands"


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `umov`; ends in SystemExit.

    The commands live in packages above this one, so they are found by their entry points, and only the one that is
    asked for is imported.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    # Of this distribution alone: the metadata of all installed packages take half a second to read.
    package = distribution("umov")
    commands = {point.name: point for point in package.entry_points if point.group == GROUP}
    usage = (
        f"Usage: umov COMMAND [OPTIONS]\n\nCommands: {', '.join(commands)}\n\n`umov COMMAND -h` explains a command. "
    )
    usage += "Commands of `process` need no `process`: umov check, umov init instrument."
    if not words or words[0] in ("-h", "--help"):
        typer.echo(usage)
        sys.exit(0 if words else 2)
    if words[0] == "--version":
        typer.echo(f"umov {package.version}")
        sys.exit(0)
    if words[0] not in commands and _is_of_process(words[0]):
        words.insert(0, "process")
    if words[0] not in commands:
        typer.echo(f"error: No such command {words[0]!r}; there are: {', '.join(commands)}", err=True)
        sys.exit(2)
    # The command reads its words here, usage names the program by it; commands that are suggested begin with UMOV_DOOR.
    sys.argv = [f"umov {words[0]}", *words[1:]]
    os.environ.setdefault("UMOV_DOOR", "umov")
    try:
        commands[words[0]].load()()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _is_of_process(word: str) -> bool:
    from processing.commands.application import app

    return word in {entry.name for entry in app.registered_commands}


if __name__ == "__main__":
    main()
