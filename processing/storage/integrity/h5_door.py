"""The door for HDF5 and .npy files: names, types and shapes are looked at before anything is read."""

import os
import threading
import time
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
from numpy.lib.format import MAGIC_PREFIX, read_array, read_array_header_1_0, read_array_header_2_0, read_magic

from processing.doors import one_line, require_file
from processing.errors import ProcessError
from processing.storage.integrity.text_heaps import endless_heap

#: What h5py and numpy raise over a damaged file, or one with other things in it than its marks promise.
DAMAGE = (
    *(KeyError, OSError, ValueError, TypeError, RuntimeError, AttributeError),
    *(IndexError, OverflowError, MemoryError),
)
#: Most states of a capture and most numbers of a table beside the frames.
MOST_STATES = 100_000
#: Most groups and datasets of a file; ours have a few hundred.
MOST_LINKS = 20_000
#: Files that have passed a check, by their state then: a campaign opens each capture many times.
_passed: set[tuple[Any, ...]] = set()
MOST_KEPT = 4096
#: A file that is younger may change again within the same tick of its clock.
SETTLED_NS = 100_000_000
#: The header is Python's text, and Python 3.11 cannot parse in two threads: "AST constructor recursion depth mismatch".
_parsing = threading.Lock()
#: A compressed dataset larger than this many times its storage is none that a camera made (deflate ends at 1032).
MOST_RATIO = 1100


def open_h5(path: Path, error: type[ProcessError], hint: str = "") -> h5py.File:
    """The file, open for reading. Raises `error` where it is not there or no HDF5; `hint` ends the message."""
    require_file(path, error)
    if (heap := endless_heap(path)) is not None:
        raise error(f"{path} cannot be read as HDF5: its texts at byte {heap:,} are damaged. {hint}".strip())
    try:
        h5 = h5py.File(path, "r")
    except DAMAGE as why:
        if not h5py.is_hdf5(path):
            raise error(f"{path} cannot be opened as HDF5: it is of another kind, or its beginning is damaged") from why
        text = f"{path} cannot be opened as HDF5 ({one_line(why)}). It is truncated or damaged. {hint}"
        raise error(text.strip()) from why
    with closed_if_damaged(h5, error, f"{path} cannot be read"):
        look_once(h5, _require_own, h5)
    return h5


def look_once(h5: h5py.File, check: Callable[..., None], *arguments: Any) -> None:
    """Call a check that raises, unless the same file has passed it and has not changed since then."""
    status = os.fstat(h5.id.get_vfd_handle())
    mark = (check, status.st_dev, status.st_ino, status.st_size, status.st_ctime_ns)
    if mark in _passed:
        return
    check(*arguments)
    if time.time_ns() - status.st_ctime_ns > SETTLED_NS:
        if len(_passed) >= MOST_KEPT:
            _passed.clear()
        _passed.add(mark)


def _require_own(h5: h5py.File) -> None:
    """Raise ValueError if a part of a file lies in another file: that may be a pipe, or private data."""
    count = 0

    # The low-level interface makes no object for a part: a quarter of the time of `visititems_links`.
    def look(name: bytes, link: Any) -> str | None:
        nonlocal count
        count += 1
        if link.type == h5py.h5l.TYPE_HARD:
            try:
                node = h5py.h5o.open(h5.id, name)
            except KeyError:
                return None
            if isinstance(node, h5py.h5d.DatasetID):
                creation = node.get_create_plist()
                if creation.get_layout() == h5py.h5d.VIRTUAL or creation.get_external_count():
                    return f"{one_line(name.decode(errors='replace'))} lies in another file"
        elif link.type != h5py.h5l.TYPE_SOFT:
            place = name.decode(errors="replace")
            target = h5.get(place, getlink=True)
            of = f", {one_line(target.filename)}" if isinstance(target, h5py.ExternalLink) else ""
            return f"{one_line(place)} is a link into another file{of}"
        return f"more than {MOST_LINKS:,} parts" if count > MOST_LINKS else None

    try:
        problem = h5.id.links.visit(look, info=True)
    except SystemError as why:
        # How h5py passes on what HDF5 says of damage below its callback.
        raise ValueError(str(why.__cause__ or why)) from why
    if problem is not None:
        raise ValueError(problem)


class OpenH5:
    """A file that is open until `close` or the end of a `with` block."""

    _h5: h5py.File

    def close(self) -> None:
        """Close the file."""
        self._h5.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def mark_of(path: Path, name: str) -> Any:
    """An attribute of an HDF5 file; None if the file is none, is damaged, or has no such attribute."""
    # A file of the kernel says that it is empty, and reading it may not end.
    if not os.path.isfile(path) or os.path.getsize(path) == 0:
        return None
    try:
        if endless_heap(Path(path)) is not None:
            return None
        with h5py.File(path, "r") as h5:
            return h5.attrs.get(name)
    except DAMAGE:
        return None


@contextmanager
def damage_as(error: type[ProcessError], text: str) -> Iterator[None]:
    """Damage found while reading becomes `error`: one line that starts with `text`."""
    try:
        yield
    except ProcessError:
        raise
    except DAMAGE as why:
        raise error(f"{text} ({one_line(why)})") from why


@contextmanager
def closed_if_damaged(h5: h5py.File, error: type[ProcessError], text: str) -> Iterator[None]:
    """The same while a file is read for the first time; it does not stay open then."""
    try:
        with damage_as(error, text):
            yield
    except error:
        h5.close()
        raise


def require_dataset(parent: h5py.Group, name: str, shape: Sequence[int | None], kinds: str) -> h5py.Dataset:
    """A dataset of a group, looked at but not read.

    Parameters
    ----------
    shape : length of each dimension; None for any.
    kinds : numpy's letters of the types allowed: u, i, f, S (fixed text), O (text).

    Raises
    ------
    ValueError
        It is not there, no dataset, or of another shape or type; or its values are not in the file.
    """
    dataset = parent.get(name)
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"there is no dataset {name}")
    actual = dataset.shape or ()
    if len(actual) != len(shape) or any(want not in (None, got) for want, got in zip(shape, actual, strict=True)):
        expected = " x ".join("any" if want is None else str(want) for want in shape) or "one value"
        raise ValueError(f"{name} has the shape {actual}, not {expected}")
    if dataset.dtype.kind not in kinds:
        raise ValueError(f"{name} holds {dataset.dtype}")
    if dataset.dtype.kind != "O" and dataset.size:
        _require_stored(dataset, name)
    return dataset


def require_group(parent: h5py.Group, name: str) -> h5py.Group:
    """A group of a group. Raises ValueError: `in` reads a dataset that stands in its place from end to end."""
    group = parent.get(name)
    if not isinstance(group, h5py.Group):
        raise ValueError(f"there is no group {name}")
    return group


def _require_stored(dataset: h5py.Dataset, name: str) -> None:
    # A shape is a few bytes in the file and may promise any amount of memory.
    stored, size = dataset.id.get_storage_size(), int(np.prod(dataset.shape, dtype=object)) * dataset.dtype.itemsize
    compact = dataset.id.get_create_plist().get_layout() == h5py.h5d.COMPACT
    filtered = dataset.compression is not None
    if size > stored * (MOST_RATIO if filtered else 1) and not compact:
        raise ValueError(f"{name} should have {size:,} bytes and has {stored:,} in the file")


def read_npy(path: Path, error: type[ProcessError], most_bytes: int | None = None) -> np.ndarray[Any, np.dtype[Any]]:
    """An array of plain numbers in a .npy file, as a read-only memory map. Raises `error`."""
    require_file(path, error, most_bytes)
    try:
        with open(path, "rb") as file:
            if file.read(len(MAGIC_PREFIX)) != MAGIC_PREFIX:
                raise error(f"{path} is no .npy file")
        with _parsing:
            values = np.load(path, mmap_mode="r", allow_pickle=False)
    except (*DAMAGE, SyntaxError, EOFError, tokenize.TokenError) as why:
        # The header is Python's text, and damaged text is a matter of its parser.
        raise error(f"{path} cannot be read as .npy ({one_line(why)})") from why
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "uif":
        raise error(f"{path} holds {getattr(values, 'dtype', 'an archive')}, not an array of numbers")
    return values


def read_npz(path: Path, name: str, error: type[ProcessError]) -> np.ndarray[Any, np.dtype[Any]]:
    """An array of plain numbers of a .npz file. Raises `error`."""
    require_file(path, error)
    try:
        with zipfile.ZipFile(path) as archive:
            member = archive.getinfo(f"{name}.npy")
            with archive.open(member) as file:
                version = read_magic(file)
                shape, _, dtype = (read_array_header_1_0 if version == (1, 0) else read_array_header_2_0)(file)
            promised = int(np.prod(shape, dtype=object)) * dtype.itemsize
            if not promised <= member.file_size <= max(member.compress_size, 1) * MOST_RATIO:
                stored = member.compress_size
                raise error(f"{path}: {name} should have {promised:,} bytes and has {stored:,} in the file")
            with archive.open(member) as file:
                values = read_array(file, allow_pickle=False)
    except (*DAMAGE, SyntaxError, EOFError, tokenize.TokenError, zipfile.BadZipFile, zlib.error) as why:
        raise error(f"{path}: {name} cannot be read ({one_line(why)})") from why
    if values.dtype.kind not in "uif":
        raise error(f"{path}: {name} holds {values.dtype}, not an array of numbers")
    return np.asarray(values)


def text_attribute(node: Any, name: str) -> str:
    """An attribute that is one text. Raises ValueError."""
    value = node.attrs[name]
    if not isinstance(value, str):
        raise ValueError(f"the attribute {name} is no text")
    return value
