"""A capture file whose layout is there, written in its place with plain system calls.

Every byte of a capture has its place before the first motion. A state is then a few writes at known places and two
syncs: HDF5 has no part in it, so it cannot leave its own structures half written, and a disc that blocks holds neither
its lock nor Python's.
"""

import contextlib
import errno
import fcntl
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from acquisition.capture.layout import STATUS_AT, write_whole
from acquisition.capture.text_box import TextBox
from acquisition.errors import AcquisitionError
from processing.storage.captures.schema import STATUS_TYPE, Status, fitted_json, json_bytes
from processing.storage.captures.segments import decode_lines, encode_line
from processing.storage.integrity.checksums import row_crc32, state_crc32

#: How long the disc process of a run that was killed may have the file open.
KILLED_S = 2.0
#: Checksum, blank and line break of a line of the journal.
LINE_BYTES = 10
#: An image is written in pieces of so many bytes: the disc works on one while the next is copied.
PIECE = 1 << 20
#: Errors that HDF5 and the look-ups raise for a damaged file.
UNREADABLE = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError)


class _Place:
    """Where a dataset without chunks lies in the file: its first byte, bytes of a row, type of a value."""

    def __init__(self, dataset: h5py.Dataset) -> None:
        offset = dataset.id.get_offset()
        if offset is None:
            raise ValueError(f"{dataset.name} has no place of its own in the file")
        self.offset: int = offset
        self.dtype = dataset.dtype
        self.step = self.dtype.itemsize * int(np.prod(dataset.shape[1:]))


class StateFile:
    """An open capture file in which states are written at their places.

    Parameters
    ----------
    path : of a file with the layout of `capture_schema.create_layout`.

    Raises
    ------
    AcquisitionError
        Another program has the file open, or it is not a whole capture.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except OSError as error:
            raise AcquisitionError(f"{path} cannot be opened to resume ({error.strerror}).") from error
        try:
            self._find_places()
            self._lock()
        except BlockingIOError:
            os.close(self._file)
            raise AcquisitionError(
                f"{path} cannot be opened to resume: another program has it open. End that one first."
            ) from None
        except UNREADABLE as error:
            os.close(self._file)
            raise AcquisitionError(
                f"{path} cannot be opened to resume ({error}). If another program has it open, end that one; if the "
                "file is damaged, begin a new capture."
            ) from error

    def _lock(self) -> None:
        """Take the lock that HDF5 takes as well, so that no program opens the file while it is written."""
        try:
            lock(self._file)
        except OSError as error:
            # Some file systems of other machines have no locks; HDF5 goes without there too.
            if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
                raise

    def _find_places(self) -> None:
        with h5py.File(self.path, "r") as h5:
            entry = h5["entry"]
            states, detector = entry["states"], entry["instrument/detector"]
            self.states: int = states["done"].shape[0]
            self._columns = {name: _Place(states[name]) for name in states if name != "role"}
            self._axes = {
                axis: {name: _Place(group[name]) for name in ("value", "raw_value")}
                for axis, group in entry["instrument"].items()
                if group.attrs.get("NX_class") == "NXpositioner"
            }
            self._row_sums = _Place(detector["row_crc32"])
            self._segments = TextBox(self._file, entry["segments/json"])
            self._status_at = int(entry.attrs[STATUS_AT])
            self._closing = TextBox(self._file, entry["closing/json"])
            data = detector["data"]
            if data.compression is not None:
                raise ValueError("its frames are compressed and stay as they are")
            self.frame_shape: tuple[int, int] = data.shape[2:]
            self._frames = [
                [data.id.get_chunk_info_by_coord((k, c, 0, 0)).byte_offset for c in range(data.shape[1])]
                for k in range(data.shape[0])
            ]
            self._frame_type = data.dtype

    def write_state(
        self, state: int, pixels: NDArray[Any], positions: Mapping[str, tuple[float, float]], values: Mapping[str, Any]
    ) -> None:
        """Write a state and its checksum; it is on the disc, and then marked done there, when this returns.

        Parameters
        ----------
        pixels : counts (channels, rows, columns).
        positions : for each axis, degrees and the controller's own number.
        values : of the state's columns; those that are not given stay as they are.
        """
        pixels = np.ascontiguousarray(pixels, dtype=self._frame_type)
        for channel, image in enumerate(pixels):
            self._write_image(self._frames[state][channel], image)
        sums = row_crc32(pixels)
        self._put(self._row_sums, state, sums)
        for axis, (degrees, counts) in positions.items():
            self._put(self._axes[axis]["value"], state, degrees)
            self._put(self._axes[axis]["raw_value"], state, counts)
        for name, value in values.items():
            self._put(self._columns[name], state, value)
        self._put(self._columns["crc32"], state, state_crc32(sums, self._read_values(state)))
        self.sync()
        self._put(self._columns["done"], state, 1)
        self.sync()

    def _read_values(self, state: int) -> dict[str, np.generic]:
        """Values of a state as the file has them, but for its mark and its checksum."""
        columns = {name: column for name, column in self._columns.items() if name not in ("done", "crc32")}
        columns |= {f"{axis}/{name}": column for axis, pair in self._axes.items() for name, column in pair.items()}
        return {name: self._get(column, state) for name, column in columns.items()}

    def read_column(self, name: str) -> NDArray[Any]:
        """A column of all planned states."""
        column = self._columns[name]
        raw = os.pread(self._file, self.states * column.step, column.offset)
        return np.frombuffer(raw, column.dtype).copy()

    def write_column(self, name: str, values: NDArray[Any]) -> None:
        """Replace a column of all planned states."""
        column = self._columns[name]
        self._write(column.offset, np.ascontiguousarray(values, dtype=column.dtype))
        self.sync()

    def add_segment_record(self, record: Mapping[str, Any], part: float = 1.0) -> None:
        """Add a line to the journal of segments, cut to this part of the room left. Raises AcquisitionError if full."""
        end = self._journal()[1]
        room = int(part * (self._segments.room - end)) - LINE_BYTES
        raw = json_bytes(record) if part == 1 else fitted_json(record, max(room, 0))
        if len(raw) > room:
            raise AcquisitionError(
                f"{self.path} was resumed so often that its journal is full. Start it again with --as-new."
            )
        # The rest of a line that was cut off is removed with it.
        self._write_text(self._segments, end, encode_line(raw))

    def segment_records(self) -> list[dict[str, Any]]:
        """The lines of the journal of segments."""
        return self._journal()[0]

    def _journal(self) -> tuple[list[dict[str, Any]], int]:
        return decode_lines(self._segments.read(self._file))

    def write_closing(self, record: Mapping[str, Any]) -> None:
        """Replace the closing record; one that is too long loses what `fitted_json` leaves out."""
        self._write_text(self._closing, 0, fitted_json(record, self._closing.room))

    def forget(self) -> None:
        """Mark every state as not done."""
        self.write_column("done", np.zeros(self.states))

    def require_at(self, path: Path) -> None:
        """Raise AcquisitionError if the file no longer has that name: all data written to it would be lost."""
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(self._file), os.stat(path)):
                return
        raise AcquisitionError(
            f"{path} was deleted or moved while it was written. Put it back where it was, then continue with "
            "--resume; if it is lost, begin a new capture."
        )

    def write_status(self, status: Status) -> None:
        """Replace the status, in the bytes that it has."""
        self._write(self._status_at, np.frombuffer(status.encode().ljust(STATUS_TYPE.itemsize, b"\0"), np.uint8))
        self.sync()

    def sync(self) -> None:
        """Return when all that was written is on the disc."""
        os.fdatasync(self._file)

    def close(self) -> None:
        """Let go of the file; never raises."""
        # The number may belong to another file from now on.
        number, self._file = self._file, -1
        with contextlib.suppress(OSError):
            os.close(number)

    def _put(self, column: _Place, state: int, value: Any) -> None:
        self._write(column.offset + state * column.step, np.asarray(value, dtype=column.dtype))

    def _get(self, column: _Place, state: int) -> np.generic:
        raw = os.pread(self._file, column.step, column.offset + state * column.step)
        value: np.generic = np.frombuffer(raw, column.dtype)[0]
        return value

    def _write(self, offset: int, values: NDArray[Any]) -> None:
        write_whole(self._file, offset, _bytes_of(values))

    def _write_text(self, box: TextBox, start: int, raw: bytes) -> None:
        """Replace a text from a byte on, and end it there; on the disc when this returns.

        Whenever this is cut off, what readers are shown is the text before or the text now, with zero bytes behind it:
        it grows before and shrinks after it is written, and behind its end there are zero bytes alone.
        """
        before, now = box.length(self._file), start + len(raw)
        if now > before:
            self._set_length(box, now)
        self._write(box.offset + start, np.frombuffer(raw.ljust(before - start, b"\0"), np.uint8))
        self.sync()
        if now < before:
            self._set_length(box, now)

    def _set_length(self, box: TextBox, length: int) -> None:
        box.set_length(self._file, length)
        self.sync()

    def _write_image(self, offset: int, image: NDArray[Any]) -> None:
        """Write an image and have the disc begin with it; that it is there says the sync alone."""
        raw = _bytes_of(image)
        for start in range(0, len(raw), PIECE):
            piece = raw[start : start + PIECE]
            write_whole(self._file, offset + start, piece)
            # Pages that are not needed are written at once, without waiting. Some file systems do not support it.
            with contextlib.suppress(OSError):
                os.posix_fadvise(self._file, offset + start, len(piece), os.POSIX_FADV_DONTNEED)


def lock(file: int) -> None:
    """Lock an open file; that of a run that was killed is free once its disc process has ended. Raises OSError."""
    end_s = time.monotonic() + KILLED_S
    while True:
        try:
            return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > end_s:
                raise
            time.sleep(0.02)


def wait_until_free(path: Path) -> None:
    """Return when no other program writes a file, or after a while."""
    with contextlib.suppress(OSError):
        # A pipe would be waited for.
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        try:
            lock(file)
        finally:
            os.close(file)


def _bytes_of(values: NDArray[Any]) -> memoryview:
    return np.ascontiguousarray(values).reshape(-1).view(np.uint8).data
