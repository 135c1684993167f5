"""Puts the layout of a capture on the disc: made by HDF5 in memory, copied by plain system calls.

An error of the disc inside HDF5 can bring the interpreter down, or be passed over. Here HDF5 never writes to the disc:
neither now nor later, for which the place of the status is noted in the file.
"""

import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from acquisition.capture.text_box import TextBox
from processing.storage.captures.schema import STATUS_TYPE, reserve_texts
from processing.whole_file import open_plain

#: Attribute of the entry: at which byte of the file its status stands.
STATUS_AT = "status_at"
#: Stand for the two while their places are looked for; nothing else in a layout has these bytes.
STATUS_MARK = b"\x01!stat!\x02"
PLACE_MARK = b"\x03!place\x04"
RUNNING = b"running".ljust(len(STATUS_MARK), b"\0")
#: Largest piece that is copied at once.
PIECE = 1 << 20


def put_layout(path: Path, needed: int, make: Callable[[h5py.File], None], begin: bytes = b"") -> None:
    """Make a new file on the disc, with all its space taken and all of it synced.

    Parameters
    ----------
    needed : bytes to take at first, about what the file will have.
    make : fills the empty file, with `create_layout` and what goes with it.
    begin : first line of the journal of segments.

    Raises
    ------
    OSError
        The disc has not enough room, or fails.
    """
    file = open_plain(path, os.O_WRONLY)
    os.ftruncate(file, 0)
    memory = os.memfd_create("capture layout", os.MFD_CLOEXEC)
    try:
        # A limit on the size of files holds for memory too: it is met here, and not inside HDF5.
        os.posix_fallocate(file, 0, needed)
        with open(memory, "w+b", buffering=0, closefd=False) as image, h5py.File(image, "w") as h5:
            make(h5)
            entry = h5["entry"]
            texts = reserve_texts(entry, begin)
            entry.attrs.modify("status", np.array(STATUS_MARK, dtype=STATUS_TYPE))
            entry.attrs[STATUS_AT] = np.frombuffer(PLACE_MARK, np.int64)[0]
            h5.flush()
            lengths = [(TextBox(memory, dataset), length) for dataset, length in texts.items()]
        for box, length in lengths:
            box.set_length(memory, length)
        _mark_places(memory)
        size = os.fstat(memory).st_size
        os.posix_fallocate(file, 0, size)
        os.ftruncate(file, size)
        for start, piece in _pieces(memory):
            write_whole(file, start, memoryview(piece))
        os.fsync(file)
    finally:
        os.close(memory)
        os.close(file)


def _mark_places(memory: int) -> None:
    """Write the place of the status into the file, and the status itself."""
    offsets: dict[bytes, int] = {}
    for start, piece in _pieces(memory, overlap=len(STATUS_MARK)):
        for mark in (STATUS_MARK, PLACE_MARK):
            if (index := piece.find(mark)) >= 0:
                offsets[mark] = start + index
    os.pwrite(memory, np.int64(offsets[STATUS_MARK]).tobytes(), offsets[PLACE_MARK])
    os.pwrite(memory, RUNNING, offsets[STATUS_MARK])


def _pieces(memory: int, overlap: int = 0) -> list[tuple[int, bytes]]:
    """Where something was written, and what; frames were not, they are holes."""
    pieces = []
    end, size = 0, os.fstat(memory).st_size
    while end < size:
        try:
            start = os.lseek(memory, end, os.SEEK_DATA)
        except OSError:
            # Nothing but a hole is left.
            break
        end = min(os.lseek(memory, start, os.SEEK_HOLE), start + PIECE)
        pieces.append((start, os.pread(memory, end - start + overlap, start)))
    return pieces


def write_whole(file: int, offset: int, raw: memoryview) -> None:
    """Write all bytes at a place, however many calls that takes. Raises OSError."""
    while raw:
        count = os.pwrite(file, raw, offset)
        raw, offset = raw[count:], offset + count
