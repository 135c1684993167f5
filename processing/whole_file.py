"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A name to write to; the file gets its own, and replaces one of that name, when the block has ended well.

    Where the block fails, on a full disc say, nothing of it is left and a file that was there is as it was.

    Raises
    ------
    OSError
    """
    path = path.resolve()
    if path.exists() and not path.is_file():
        # A terminal or a pipe: there is nothing to replace.
        yield path
        return
    # Its ending stays last: libraries tell the format by it.
    new = path.with_name(f".{path.stem}.new{path.suffix}")
    try:
        yield new
        file = os.open(new, os.O_RDONLY)
        try:
            # A disc may tell only now that it is full.
            os.fsync(file)
        finally:
            os.close(file)
        os.replace(new, path)
    except BaseException:
        new.unlink(missing_ok=True)
        raise


def write_whole_text(path: Path, text: str) -> None:
    """Write text as UTF-8, wholly or not at all. Raises OSError."""
    with whole_file(path) as new:
        new.write_text(text, encoding="utf-8")
