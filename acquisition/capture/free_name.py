"""A unique file name for a new capture, also if several programs begin in the same second."""

import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from acquisition.capture.partial_file import NEW, PARTIAL
from acquisition.capture.synced import make_folder
from acquisition.disc import on_disc
from acquisition.errors import AcquisitionError


@contextmanager
def free_name(path: Path) -> Iterator[Path]:
    """The path, or NAME-2.h5, NAME-3.h5 ... if that exists; reserved until the end of the block.

    Raises AcquisitionError: the folder cannot be written.
    """
    try:
        free = on_disc(f"create {path}", _take, path)
    except OSError as error:
        raise AcquisitionError(f"{path} cannot be created ({error}). Choose another folder with --out.") from error
    try:
        yield free
    finally:
        # Not there any more once the capture has begun.
        with suppress(OSError, AcquisitionError):
            on_disc(f"remove {_append_ending(free, NEW)}", _append_ending(free, NEW).unlink, missing_ok=True)


def _take(path: Path) -> Path:
    make_folder(path.parent)
    return next(name for name in _candidates(path) if _claim(name))


def _candidates(path: Path) -> Iterator[Path]:
    yield path
    yield from (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))


def _claim(path: Path) -> bool:
    """Whether the capture may have this name; if so, its first file stands for it from now on."""
    try:
        os.close(os.open(_append_ending(path, NEW), os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666))
    except FileExistsError:
        return False
    # Looked at in the order in which a capture changes its name, so that none slips through between two looks.
    if _append_ending(path, PARTIAL).exists() or path.exists():
        _append_ending(path, NEW).unlink()
        return False
    return True


def _append_ending(path: Path, ending: str) -> Path:
    return path.with_name(path.name + ending)
