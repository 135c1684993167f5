"""Read states.csv: one row per state, with errors that name line and column."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.doors import one_line
from processing.storage.captures.schema import NOT_AXES
from processing.storage.formats.foreign_arrays import ImportFailed, is_array, read_column
from processing.storage.formats.text_table import Row, read_table

ROLES = ("sample", "air", "dark", "flat")
CHANNEL_PREFIX = "channel_"
#: Columns that are no axes.
KNOWN = ("state", "role", "file", "time_s", "exposure_s", "sigma")
#: Columns in another unit, and the factor to seconds.
MILLI = {"time_ms": "time_s", "exposure_ms": "exposure_s"}
#: In the place of a column for `state`: the states are in the order of the rows.
IN_ORDER = "rows"
#: What a column must look like, as a name in the capture file.
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_ .-]{0,63}")
_THOUSANDS = re.compile(r"[-+]?\d{1,3}(,\d{3})+(\.\d*)?")
#: Largest angle in degrees; controllers count no further.
MOST_DEG = 1e6


@dataclass(frozen=True)
class StatesFile:
    """Contents of states.csv, in the order of its `state` column.

    Attributes
    ----------
    path : of the file.
    line : line number of each state, for messages.
    angles_deg : axis name to (N,); NaN in dark and flat states that have none.
    role : N roles; "sample" unless a `role` column says otherwise.
    time_s, exposure_s : (N,) or None.
    sigma : (N,) standard deviation of the noise of one value of the state, in counts, or None.
    files : N names of files as they stand in the table, or None.
    channels : channel name to (N,) flux; empty if there are none.
    ignored : columns of the table that are not used: header to N cells.
    units : header to unit, where the table has a line of units below its header.
    """

    path: Path
    line: tuple[int, ...]
    angles_deg: dict[str, NDArray[np.float64]]
    role: tuple[str, ...]
    time_s: NDArray[np.float64] | None
    exposure_s: NDArray[np.float64] | None
    sigma: NDArray[np.float64] | None
    files: tuple[str, ...] | None
    channels: dict[str, NDArray[np.float64]]
    ignored: dict[str, list[str]]
    units: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.role)

    def repeated(self, times: int) -> "StatesFile":
        """Each state so many times, one after the other."""
        if times == 1 or self.files is not None:
            return self

        def longer(values: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
            return None if values is None else values.repeat(times)

        return replace(
            self,
            line=tuple(np.repeat(self.line, times).tolist()),
            role=tuple(np.repeat(self.role, times).tolist()),
            angles_deg={name: values.repeat(times) for name, values in self.angles_deg.items()},
            time_s=longer(self.time_s),
            exposure_s=longer(self.exposure_s),
            sigma=longer(self.sigma),
            channels={name: values.repeat(times) for name, values in self.channels.items()},
            ignored={name: np.repeat(cells, times).tolist() for name, cells in self.ignored.items()},
        )


def read_states(
    path: Path | None,
    axes: Sequence[str],
    columns: Mapping[str, str] | None = None,
    radians: bool = False,
    *,
    arrays: Mapping[str, NDArray[np.float64]] | None = None,
    count: int | None = None,
    source: str = "frames",
) -> StatesFile:
    """Read a states file (CSV with a header line), arrays with a number a state, or both.

    Columns are apart by commas, semicolons, tabs or blanks, as the header has them. Beside semicolons and tabs numbers
    may have decimal commas; then none has a point. Lines before the header, and one of units after it, are skipped.

    Parameters
    ----------
    axes : names that must have a column (the instrument's axes), with or without a suffix `_deg`; any other column
        with that suffix is an axis too. Else there are `state`, `role`, `time_s`, `exposure_s`, `sigma`, `file` and
        `channel_<name>`, and no others.
    columns : where the numbers of a name stand: a header of the file, or an array in another file (`FILE::NAME`). With
        it other columns of the file are not read, and states without a number are in the order of the rows.
    radians : whether angles are given in radians.
    arrays : name to (N,), numbers that are known already.
    count : states where neither a file nor an array says how many there are.
    source : name for messages where there is no file.

    Raises
    ------
    ImportFailed : not readable, a column is missing, unknown or given twice, a number is none, a state is repeated.
    """
    mapping = {_axis_name(name): text for name, text in (columns or {}).items()}
    vectors = {name: read_column(text) for name, text in mapping.items() if is_array(text)} | dict(arrays or {})
    if path is not None:
        header, rows, units, delimiter = read_table(
            path, [text for name, text in mapping.items() if name not in vectors and text != IN_ORDER]
        )
    else:
        header, rows, units, delimiter = [], _rows_without_table(vectors, count), {}, ","
    path = path or Path(next((t for t in mapping.values() if is_array(t)), source).partition("::")[0])
    ignored: dict[str, list[str]] = {}
    if mapping:
        of_file = {n: t for n, t in mapping.items() if n not in vectors}
        header, rows, ignored = _map_columns(path, header, rows, of_file, axes=axes)
    if "state" not in header:
        header, rows = ["state", *header], [(line, [str(k), *row]) for k, (line, row) in enumerate(rows)]
    header, rows = _with_arrays(path, header, rows, vectors)
    names = [_axis_name(h) for h in header]
    _require_columns(path, header, names, axes)
    _check_names(path, names)
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ImportFailed(f"{path}:1: column given twice: {', '.join(twice)}")
    unknown = [h for h, n in zip(header, names, strict=True) if not _is_known(h, n, axes)]
    if unknown:
        raise ImportFailed(
            f"{path}:1: unknown column {one_line(', '.join(unknown))}. An axis is called <axis>_deg; else there are "
            f"{', '.join(KNOWN)} and {CHANNEL_PREFIX}<name>. Columns are ignored once one of those used is named: "
            f"--columns '{next(iter(axes), 'AXIS')}=COLUMN'"
        )
    texts_of = {name: [row[k] for _, row in rows] for k, name in enumerate(names)}
    lines = [line for line, _ in rows]
    order = _order(path, lines, texts_of["state"])
    lines = [lines[k] for k in order]
    texts_of = {name: [values[k] for k in order] for name, values in texts_of.items()}
    role = _roles(path, lines, texts_of)
    cells = {n: texts_of[n] for n in names if n not in ("state", "role", "file")}
    with_comma = [text for texts in cells.values() for text in texts if "," in text]
    # Between commas a number has quotes, and its comma may part thousands.
    decimal_commas = bool(with_comma) and (delimiter != "," or not all(map(_THOUSANDS.fullmatch, with_comma)))
    numbers = {
        n: _numbers(path, lines, n, texts, role=role, decimal_commas=decimal_commas) for n, texts in cells.items()
    }
    numbers |= {MILLI[n]: numbers.pop(n) / 1000 for n in tuple(numbers) if n in MILLI}
    turned = [n for n in numbers if not _is_known(n, n, ())]
    if radians:
        numbers.update({n: np.rad2deg(numbers[n]) for n in turned})
    files = _files(path, lines, texts_of["file"]) if "file" in texts_of else None
    _check_above_zero(path, lines, "sigma", numbers.get("sigma"))
    _check_above_zero(path, lines, "exposure_s", numbers.get("exposure_s"))
    _check_angles(path, lines, turned, numbers)
    if set(role) <= {"dark"}:
        raise ImportFailed(f"{path}: every state is dark; give the role of those with light in the column role")
    return StatesFile(
        path=path,
        line=tuple(lines),
        angles_deg={n: numbers[n] for n in turned},
        role=role,
        time_s=numbers.get("time_s"),
        exposure_s=numbers.get("exposure_s"),
        sigma=numbers.get("sigma"),
        files=files,
        channels={n.removeprefix(CHANNEL_PREFIX): v for n, v in numbers.items() if n.startswith(CHANNEL_PREFIX)},
        ignored={name: [cells[k] for k in order] for name, cells in ignored.items()},
        units=units,
    )


def _rows_without_table(vectors: Mapping[str, NDArray[np.float64]], count: int | None) -> list[Row]:
    """Rows without columns, one for each number of the first array, or `count`."""
    if vectors:
        count = len(next(iter(vectors.values())))
    if count is None:
        raise ImportFailed(
            "no states: give --states FILE.csv, the angles of each axis as --columns AXIS=FILE::NAME, or frames that "
            "have them in their names as --stack 'FOLDER/name_{AXIS}.tif'"
        )
    return [(k + 1, []) for k in range(count)]


def _map_columns(
    path: Path, header: list[str], rows: list[Row], mapping: Mapping[str, str], *, axes: Sequence[str]
) -> tuple[list[str], list[Row], dict[str, list[str]]]:
    """The columns that have a name here, by the mapping or already in the file; and the others."""
    in_order = mapping.get("state") == IN_ORDER and IN_ORDER not in header
    mapping = {name: text for name, text in mapping.items() if not (in_order and name == "state")}
    absent = [text for text in mapping.values() if text not in header]
    if absent:
        raise ImportFailed(f"{path}:1: no column {absent[0]!r}. Found: {', '.join(header)}")
    columns, ignored = [], {}
    for k, h in enumerate(header):
        of_file = _axis_name(h) not in mapping and _is_known(h, _axis_name(h), axes)
        # One column may turn two axes.
        names = [name for name, text in mapping.items() if text == h]
        if not names and of_file and not (in_order and h == "state"):
            names = [h]
        columns += [(k, name) for name in names]
        if not names:
            ignored[h] = [row[k] for _, row in rows]
    header, rows = [h for _, h in columns], [(line, [row[k] for k, _ in columns]) for line, row in rows]
    if "state" not in header and not in_order and "file" not in header:
        _require_in_order(path, ignored)
    # An axis has the ending that tells it from a column that is not known.
    return [f"{h}_deg" if h in mapping and not _is_known(h, h, axes) else h for h in header], rows, ignored


def _require_in_order(path: Path, ignored: Mapping[str, list[str]]) -> None:
    """Raise ImportFailed where a column that is not used numbers the rows in another order than theirs."""
    for name, cells in ignored.items():
        if not all(c.isascii() and c.isdecimal() and len(c) < 10 for c in cells):
            continue
        numbers = [int(c) for c in cells]
        if numbers != sorted(numbers) and sorted(numbers) == list(range(min(numbers), max(numbers) + 1)):
            raise ImportFailed(
                f"{path}: column {name!r} numbers the rows from {numbers[0]} to {numbers[-1]} in another order. If it "
                f"has the order of the frames, add --columns 'state={name}', else --columns state={IN_ORDER}"
            )


def _with_arrays(
    path: Path, header: list[str], rows: list[Row], arrays: Mapping[str, NDArray[np.float64]]
) -> tuple[list[str], list[Row]]:
    """The rows with a column more for each array."""
    for name, values in arrays.items():
        if len(values) != len(rows):
            raise ImportFailed(f"--columns {name}: {len(values)} numbers for {len(rows)} states of {path}")
        header = [*header, name if _is_known(name, name, ()) else f"{name}_deg"]
        rows = [(line, [*row, repr(float(v))]) for (line, row), v in zip(rows, values, strict=True)]
    return header, rows


def _require_columns(path: Path, header: list[str], names: list[str], axes: Sequence[str]) -> None:
    """Raise ImportFailed where a column is missing."""
    missing = [n for n in axes if n not in names]
    if missing:
        heads = one_line(", ".join(h for h in header if h != "state")) or "none"
        raise ImportFailed(
            f"{path}:1: no column {', '.join(missing)}. Found: {heads}. Say which column has the angles of each axis: "
            + " ".join(f"--columns '{name}=COLUMN'" for name in missing)
        )


def _check_names(path: Path, names: Sequence[str]) -> None:
    for column, name in enumerate(names, 1):
        if not NAME.fullmatch(name):
            shown = repr(one_line(name, 40)) if name else "an empty name"
            raise ImportFailed(f"{path}:1: column {column}: {shown}; a name is letters, digits and _ and begins so")
        if name in NOT_AXES:
            raise ImportFailed(f"{path}:1: column {column}: no axis can be called {name!r}; give it another name")


def _is_known(header: str, name: str, axes: Sequence[str]) -> bool:
    return name in KNOWN or name in MILLI or name in axes or name.startswith(CHANNEL_PREFIX) or header.endswith("_deg")


def _check_above_zero(path: Path, lines: list[int], name: str, values: NDArray[np.float64] | None) -> None:
    for line, value in zip(lines, () if values is None else values, strict=values is not None):
        if value <= 0:
            raise ImportFailed(f"{path}:{line}: column {name}: {value:g} is not above 0")


def _check_angles(path: Path, lines: list[int], names: Sequence[str], values: dict[str, NDArray[np.float64]]) -> None:
    for name in names:
        for line, value in zip(lines, values[name], strict=True):
            if abs(value) > MOST_DEG:
                raise ImportFailed(f"{path}:{line}: column {name}: {value:g} is no angle; at most {MOST_DEG:g} degrees")


def _axis_name(header: str) -> str:
    return header.removesuffix("_deg")


def _order(path: Path, lines: list[int], states: list[str]) -> list[int]:
    line_of: dict[int, int] = {}
    for line, text in zip(lines, states, strict=True):
        if not text.isascii() or not text.isdecimal() or len(text) > 9:
            raise ImportFailed(f"{path}:{line}: column state: {text!r} is not a whole number")
        number = int(text)
        if number in line_of:
            raise ImportFailed(f"{path}:{line}: state {number} is given already in line {line_of[number]}")
        line_of[number] = line
    first, last = min(line_of), max(line_of)
    if last - first + 1 != len(line_of):
        missing = next(number for number in range(first, last) if number not in line_of)
        raise ImportFailed(
            f"{path}: state {missing} is missing between {first} and {last}. If it was not measured, add "
            f"--columns state={IN_ORDER}"
        )
    return sorted(range(len(states)), key=lambda k: int(states[k]))


def _files(path: Path, lines: list[int], names: list[str]) -> tuple[str, ...]:
    line_of: dict[str, int] = {}
    for line, name in zip(lines, names, strict=True):
        if not name or "\0" in name:
            raise ImportFailed(f"{path}:{line}: column file: {'no name' if not name else 'not a name of a file'}")
        if line_of.setdefault(name, line) != line:
            raise ImportFailed(f"{path}:{line}: column file: {one_line(name)} is given already in line {line_of[name]}")
    return tuple(names)


def _roles(path: Path, lines: list[int], columns: dict[str, list[str]]) -> tuple[str, ...]:
    if "role" not in columns:
        return ("sample",) * len(lines)
    roles = tuple(text or "sample" for text in columns["role"])
    for line, role in zip(lines, roles, strict=True):
        if role not in ROLES:
            raise ImportFailed(f"{path}:{line}: column role: {role!r} is none of {', '.join(ROLES)}")
    return roles


def _numbers(
    path: Path, lines: list[int], name: str, texts: list[str], *, role: tuple[str, ...], decimal_commas: bool
) -> NDArray[np.float64]:
    # A point among decimal commas could only part thousands: as a comma it is no number.
    points = str.maketrans(",.", ".,") if decimal_commas else {}
    numbers = np.empty(len(texts))
    for k, text in enumerate(texts):
        if not text and role[k] in ("dark", "flat"):
            numbers[k] = np.nan
            continue
        try:
            numbers[k] = math.nan if "_" in text else float(text.rstrip(" °").translate(points))
        except ValueError:
            numbers[k] = np.nan
        if not math.isfinite(numbers[k]):
            shown = repr(text) if text else "an empty cell"
            raise ImportFailed(f"{path}:{lines[k]}: column {name}: {shown} is not a finite number")
    return numbers
