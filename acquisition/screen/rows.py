"""Rows of a few words each: aligned and coloured on a terminal, without padding in a file or a pipe."""

from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from processing.commands.command_line import printable


def say(console: Console, text: str, style: str | None = None) -> None:
    """Print a line as it is: no square bracket is markup, no control character reaches the terminal."""
    console.print(printable(text), style=style, markup=False, highlight=False, soft_wrap=True)


def print_rows(rows: Iterable[Sequence[str]], console: Console | None = None) -> None:
    """Print rows under each other; a row that begins with BAD or REFUSED stands out.

    Off a terminal each row is one line, its cells two blanks apart: nothing is cut, wrapped, padded or coloured.
    """
    console = console or Console()
    if not console.is_terminal:
        for row in rows:
            console.out(printable("  ".join(cell for cell in row if cell)), highlight=False)
        return
    table = Table(box=None, show_header=False, pad_edge=False)
    for row in rows:
        style = "bold red" if row[0] in ("BAD", "REFUSED") else ""
        # Folded where it is too long: a truncated path would not show the mistake.
        table.add_row(*(Text(printable(cell), style, overflow="fold") for cell in row))
    console.print(table)
