"""Files that are there whole or not at all."""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processing.errors import ProcessError


@contextmanager
def whole_file(path: Path, *, new: bool = False, follow: bool = True) -> Iterator[Path]:
    """A name to write to; the file gets its own, and replaces one of that name, when the block has ended well.

    Where the block fails, on a full disc say, nothing of it is left and a file that was there is as it was.

    Parameters
    ----------
    new : replace nothing, not even a file that came while the block ran.
    follow : a link is written through; False replaces the link, for names that nobody gave.

    Raises
    ------
    FileExistsError
        There is one, and `new` was asked for.
    OSError
    """
    # Not Path.resolve(), which raises RuntimeError where links go in a circle.
    path = Path(os.path.realpath(path)) if follow else path
    if not new and path.exists() and not path.is_file():
        # A terminal or a pipe: there is nothing to replace.
        yield path
        return
    # Its ending stays last, libraries tell the format by it; another process may be writing a file of this name.
    beside = path.with_name(f".{path.stem}.{os.getpid()}.new{path.suffix}")
    try:
        yield beside
        # A disc may tell only now that it is full. Windows syncs only what is open for writing.
        with beside.open("rb+") as file:
            os.fsync(file)
        if new:
            _take_free_name(beside, path)
        else:
            os.replace(beside, path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def _take_free_name(beside: Path, path: Path) -> None:
    """Rename where the name is free; to look first and rename then would replace what came between."""
    try:
        os.link(beside, path)
    except FileExistsError:
        raise
    except OSError:
        # Sticks (exFAT) and some network discs have no second names for a file: an empty one takes it.
        path.open("x").close()
        os.replace(beside, path)
    else:
        beside.unlink()


def open_plain(path: Path, flags: int) -> int:
    """Open a file of one's own for writing, made if it is not there.

    Raises OSError: somebody has put a link, a pipe or a device there, or a second name of another file.
    """
    # Windows has neither such links nor such pipes, but would translate the ends of lines.
    for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"):
        flags |= getattr(os, name, 0)
    file = os.open(path, flags | os.O_CREAT, 0o666)
    status = os.fstat(file)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
        os.close(file)
        raise OSError(errno.EEXIST, "something else than a file of its own is there", str(path))
    return file


def make_plain(path: Path) -> None:
    """Make a file of one's own for what is appended later, or leave it as it is. Raises as `open_plain`."""
    os.close(open_plain(path, os.O_WRONLY))


def write_whole_text(path: Path, text: str, *, follow: bool = True) -> None:
    """Write text as UTF-8, wholly or not at all. Raises OSError."""
    with whole_file(path, follow=follow) as new:
        new.write_text(text, encoding="utf-8")


def write_new_text(path: Path, text: str) -> None:
    """Write text as UTF-8 into a new file, whole or not at all; ProcessError where there is one, and OSError."""
    try:
        with whole_file(path, new=True) as new:
            new.write_text(text, encoding="utf-8")
    except FileExistsError as error:
        raise ProcessError(f"{path} exists and is not replaced. Give another name.") from error
