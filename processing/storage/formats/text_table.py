"""A table of text (CSV): its header, rows with their line numbers, units and the delimiter."""

import csv
import re
from collections.abc import Sequence
from pathlib import Path

from processing.doors import read_text_of_any_system
from processing.storage.formats.foreign_arrays import ImportFailed

#: What may stand between columns; a spreadsheet takes semicolons where the comma is in the numbers.
DELIMITERS = ",;\t"
MOST_COLUMNS = 200
#: Lines of words before the header of a table, at most.
MOST_LINES_BEFORE = 60
MOST_STATES = 100_000
#: Line number and cells.
Row = tuple[int, list[str]]


def read_table(path: Path, required: Sequence[str]) -> tuple[list[str], list[Row], dict[str, str], str]:
    """Header, rows with their line numbers, units that stand in a line of their own, and the delimiter."""
    text_lines = read_text_of_any_system(path, ImportFailed).splitlines(keepends=True)
    first = next((k for k, line in enumerate(text_lines) if line.strip() and not line.startswith("#")), 0)
    if first and _is_all_numbers(text_lines[first]):
        # As numpy writes a table: its names are a comment.
        first -= 1
        text_lines[first] = text_lines[first].lstrip("# ")
    header, rows, delimiter = _parse_rows(path, text_lines, first)
    if any(len(row) != len(header) for _, row in rows) or not set(required) <= set(header):
        # A log may begin with lines on the measurement: the header is the first that fits all rows after it.
        for start in range(first + 1, min(first + MOST_LINES_BEFORE, len(text_lines))):
            table = _parse_rows(path, text_lines, start)
            fits = table[1] and all(len(row) == len(table[0]) for _, row in table[1]) and set(required) <= set(table[0])
            if fits and not any(map(_is_number, table[0])) and (required or len(table[0]) > 1):
                header, rows, delimiter = table
                break
    if header and all(_is_number(h) for h in header):
        raise ImportFailed(
            f"{path}: has no line with the names of its columns. Without --states, name each column by its number, as "
            f"--columns 'psg={path}[0]'"
        )
    if not header or not rows:
        raise ImportFailed(f"{path}: needs a header line and one row per state; found {len(rows)} rows")
    if len(header) > MOST_COLUMNS or len(rows) > MOST_STATES:
        raise ImportFailed(
            f"{path}: {len(header)} columns and {len(rows)} rows; at most {MOST_COLUMNS} and {MOST_STATES} are read"
        )
    for line, row in rows:
        if len(row) != len(header):
            raise ImportFailed(f"{path}:{line}: {len(row)} columns, the header has {len(header)}")
    units: dict[str, str] = {}
    if len(rows) > 1 and not any(map(_is_number, rows[0][1])) and any(map(_is_number, rows[1][1])):
        units, rows = dict(zip(header, rows[0][1], strict=True)), rows[1:]
    # Spreadsheets write delimiters behind the last column.
    used = [k for k, h in enumerate(header) if h or any(row[k] for _, row in rows)]
    return [header[k] for k in used], [(line, [row[k] for k in used]) for line, row in rows], units, delimiter


def _parse_rows(path: Path, text_lines: list[str], first: int) -> tuple[list[str], list[Row], str]:
    """Header and rows from one line on."""
    title = text_lines[first] if text_lines else ""
    delimiter = max(DELIMITERS, key=title.count)
    if delimiter not in title and len(text_lines) > first + 1 and len(text_lines[first + 1].split()) > 1:
        delimiter = " "
        text_lines = [" ".join(line.split()) + "\n" for line in text_lines]
    try:
        reader = csv.reader(text_lines[first:], delimiter=delimiter)
        header = [h.strip() for h in next(reader, [])]
        cells = ((first + reader.line_num, [c.strip() for c in row]) for row in reader)
        # A logger may write a delimiter behind the last column of the rows alone.
        rows = [(n, row if any(row[len(header) :]) else row[: len(header)]) for n, row in cells if any(row)]
    except csv.Error as error:
        raise ImportFailed(f"{path}: is not a CSV text file ({error})") from error
    return header, rows, delimiter


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _is_all_numbers(line: str) -> bool:
    parts = re.split(r"[;\t ]+|,\s*", line.strip())
    return all(_is_number(part) for part in parts if part)
