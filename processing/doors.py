"""What every file that people hand in has to pass before anything believes it.

A file comes in through one door for its kind: text and JSON here, YAML in `processing.yaml_file`, HDF5, pictures and
arrays in `processing.storage`. A door looks at size, depth, types and shapes before it takes memory for the content,
and says in one line what is wrong.
"""

import contextlib
import json
import os
import re
import shutil
import stat
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

from processing.errors import ProcessError

#: Most bytes of a text file (states.csv of 100,000 states has about 6 MB).
MOST_TEXT_BYTES = 16 << 20
#: Most bytes of a JSON file: an index of 10,000 captures has about 5 MB.
MOST_JSON_BYTES = 16 << 20
#: Room for what a file has beside its values (names, provenance, the measurement matrix), bytes.
BOOKS = 1 << 18
#: Most pixels of a frame (8192 x 8192).
MOST_PIXELS = 1 << 26
#: Control characters, and those that turn the direction of a text.
CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
#: Deepest nesting of lists and mappings; our own files have 8.
MOST_DEPTH = 40


def require_file(
    path: Path, error: type[ProcessError] = ProcessError, most_bytes: int | None = None, may_be_empty: bool = False
) -> int:
    """Size of a regular file in bytes; a pipe or a device would be read for ever.

    Files of the kernel, as /proc/kmsg, say that they are empty, and reading some of them never ends.

    Raises
    ------
    ProcessError
        Of the class `error`: it is not there, no regular file, or larger than `most_bytes`.
    """
    try:
        status = os.stat(path)
    except (OSError, ValueError) as why:
        raise error(f"{one_line(path)}: cannot be read ({getattr(why, 'strerror', why)})") from why
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder, and a file is asked for" if stat.S_ISDIR(status.st_mode) else "no regular file"
        raise error(f"{path}: is {kind}")
    if most_bytes is not None and status.st_size > most_bytes:
        raise error(
            f"{path}: has {status.st_size:,} bytes, a file of this kind at most {most_bytes:,}. Is it the right one?"
        )
    if status.st_size == 0 and not may_be_empty:
        raise error(f"{one_line(path)}: cannot be read: it is empty")
    return status.st_size


def require_place(path: Path, overwrite: bool = False, captures_too: bool = False) -> None:
    """Raise ProcessError unless a file can be made there: the folder is there, the name is free or may be replaced.

    A capture is never replaced, except by another one (`captures_too`): what was measured cannot be made again.
    """
    if path.exists() and not path.is_dir() and not overwrite:
        raise ProcessError(f"{path} exists. Give another --out, or --overwrite to replace it.")
    require_folder(path)
    if not captures_too and _is_capture(path):
        raise ProcessError(f"{path} is a capture, and is not replaced: it cannot be made again. Give another --out.")


def _is_capture(path: Path) -> bool:
    import h5py

    if not path.is_file():
        return False
    try:
        # One that is being written is locked, and a capture as well.
        with h5py.File(path, "r", locking=False) as h5:
            return "umov_schema" in h5.attrs
    except (OSError, RuntimeError):
        return False


def require_new(path: Path) -> None:
    """Raise ProcessError unless `path` could be the name of a new file; nothing that is there is replaced."""
    require_folder(path)
    if path.exists():
        raise ProcessError(f"{path} exists and is not replaced. Give another name.")


def require_folder(path: Path) -> None:
    """Raise ProcessError unless `path` could be the name of a file: in a folder that is there, and no folder itself."""
    if path.is_dir():
        raise ProcessError(f"{path} is a folder. Give the name of a file.")
    if not path.parent.is_dir():
        raise ProcessError(f"{path}: there is no folder {path.parent}. Make it, or give another name.")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise ProcessError(f"{path}: nothing can be written into {path.parent}. Give a name in another folder.")


def require_room(path: Path, values: int, error: type[ProcessError] = ProcessError) -> None:
    """Raise `error` unless the disc has room for a file of so many bytes of values: HDF5 would end the process."""
    needed = values + BOOKS
    replaced = path.stat().st_blocks * 512 if path.exists() else 0
    free = shutil.disk_usage(path.parent).free + replaced
    if needed > free:
        raise error(f"{path} needs {needed:,} bytes, {free:,} are free in {path.parent}. Make room, or give --out.")


def require_distinct(paths: Iterable[Path]) -> None:
    """Raise ProcessError if a file is given twice: its data would count twice, and errors would be too small."""
    first_path: dict[tuple[int, int], Path] = {}
    for path in paths:
        # What is not there is told by its reader.
        if path.exists():
            status = path.stat()
            first = first_path.setdefault((status.st_dev, status.st_ino), path)
            if first is not path:
                also = "" if first == path else f", also as {first}"
                raise ProcessError(f"{path} is given twice{also}; it would count twice.")


def require_picture(path: Path, error: type[ProcessError] = ProcessError) -> int:
    """Pages of a picture. Raises `error` if it is none or too large: a few kilobytes can promise terabytes."""
    from PIL import Image

    require_file(path, error)
    try:
        with warnings.catch_warnings():
            # Its own warning of large pictures; ours is an error.
            warnings.simplefilter("ignore")
            with Image.open(path) as picture:
                wide, high = picture.size
                pages = int(getattr(picture, "n_frames", 1))
    except Image.DecompressionBombError as why:
        raise error(f"{path}: {one_line(why)}; at most {MOST_PIXELS:,} pixels are read") from why
    except Exception as why:
        # Readers of thirty formats raise whatever they like.
        raise error(f"{path}: is not an image that can be read (PNG or TIFF)") from why
    if wide * high > MOST_PIXELS:
        raise error(f"{path}: {wide} x {high} pixels; at most {MOST_PIXELS:,} pixels are read")
    return pages


def read_bytes(path: Path, error: type[ProcessError], most_bytes: int) -> bytes:
    """Content of a regular file. Raises `error`."""
    size = require_file(path, error, most_bytes, may_be_empty=True)
    try:
        # No more than was looked at, and without waiting: another program may have put a pipe there meanwhile.
        without_waiting = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        with open(os.open(path, os.O_RDONLY | without_waiting), "rb") as file:
            return file.read(size) or b""
    except OSError as why:
        raise error(f"{path}: cannot be read ({why.strerror})") from why


def read_text(path: Path, error: type[ProcessError] = ProcessError, most_bytes: int = MOST_TEXT_BYTES) -> str:
    """Text of a UTF-8 file, with or without a byte order mark. Raises `error`."""
    try:
        return read_bytes(path, error, most_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as why:
        raise error(f"{path}: is not UTF-8 text") from why


def read_text_of_any_system(path: Path, error: type[ProcessError] = ProcessError) -> str:
    """Text of a table from a spreadsheet or a log: UTF-8, UTF-16 with a mark, or Windows-1252. Raises `error`."""
    data = read_bytes(path, error, MOST_TEXT_BYTES)
    encodings = ("utf-16",) if data[:2] in (b"\xff\xfe", b"\xfe\xff") else ("utf-8-sig", "cp1252")
    for encoding in encodings:
        with contextlib.suppress(UnicodeDecodeError):
            text = data.decode(encoding)
            if "\0" not in text:
                return text
    raise error(f"{path}: is not text (UTF-8, UTF-16 or Windows-1252)")


def parse_json(text: str | bytes, source: str, error: type[ProcessError] = ProcessError) -> Any:
    """Value of JSON text, finite numbers only. Raises `error`; `source` names the text in it."""
    try:
        value = json.loads(text, parse_constant=_refuse_constant)
        require_shallow(value)
    except (ValueError, RecursionError) as why:
        raise error(f"{source}: is not the JSON that it should be ({one_line(why)})") from why
    return value


def read_json(path: Path) -> Any:
    """Value of a JSON file. Raises ProcessError."""
    return parse_json(read_text(path, ProcessError, MOST_JSON_BYTES), str(path), ProcessError)


def is_line(text: str) -> bool:
    """Whether a text has no control characters, which move a terminal's cursor, and none that turn its direction."""
    return not CONTROL.search(text)


def require_shallow(value: Any) -> None:
    """Raise ValueError for lists and mappings nested deeper than `MOST_DEPTH`."""
    level = [value]
    for _ in range(MOST_DEPTH + 1):
        level = [item for node in level for item in _items(node)]
        if not level:
            return
    raise ValueError(f"nested deeper than {MOST_DEPTH} levels")


def one_line(text: object, most: int = 300) -> str:
    """Text without line breaks and control characters, cut where it is long: fit for a message."""
    words = " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())
    return words if len(words) <= most else words[: most - 3] + "..."


def _items(node: Any) -> list[Any]:
    if isinstance(node, dict):
        return list(node.values())
    return node if isinstance(node, list) else []


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a finite number")
