"""Writes a capture state by state so that no crash can take a state that was marked done.

All space is taken before the first motion. Each state is written, flushed, marked done and flushed again, by one
thread, while the next state is under way. A finished file loses its `.partial` and is on the disc by then.
"""

from __future__ import annotations

import errno
import os
import queue
import shutil
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from acquisition.errors import AcquisitionError
from drivers.motion import Position
from processing.instrument.states import StateTable
from processing.storage.capture_schema import CaptureHeader, Status, create_layout, write_closing

PARTIAL = ".partial"
#: Layout and notes besides the frames, and the columns of a state, generously.
LAYOUT_BYTES = 1 << 20
COLUMN_BYTES = 512


@dataclass(frozen=True)
class StateRecord:
    """One state taken: its frame, the positions read back, and the columns of the state table."""

    state: int
    pixels: NDArray[Any]
    positions: Mapping[str, Position]
    columns: Mapping[str, float] = field(default_factory=dict)


def bytes_needed(states: int, channels: int, frame_shape: tuple[int, int], itemsize: int = 2) -> int:
    """Bytes of a capture file of this size."""
    return states * (channels * frame_shape[0] * frame_shape[1] * itemsize + COLUMN_BYTES) + LAYOUT_BYTES


def check_space(folder: Path, needed: int) -> None:
    """Refuse a disc that is too small. Raises AcquisitionError with the bytes needed and free."""
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise AcquisitionError(
            f"the capture needs {needed:,} bytes in {folder}, {free:,} are free. "
            "Nothing was moved. Make room or choose another folder with --out."
        )


class CaptureWriter:
    """An open `.partial` file and the thread that writes into it.

    `put` hands over a state and returns at once; at most two states wait. An error of the writing thread is raised
    by the next `put` or by `seal`.
    """

    def __init__(self, path: Path, h5: h5py.File) -> None:
        self.path = path
        self._h5 = h5
        self._queue: queue.Queue[StateRecord | None] = queue.Queue(maxsize=2)
        self._error: BaseException | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="capture writer", daemon=True)
        self._thread.start()

    @classmethod
    def create(
        cls, path: Path, header: CaptureHeader, table: StateTable, frame_shape: tuple[int, int], start_time: str
    ) -> CaptureWriter:
        """Create `path` + ".partial" with everything allocated.

        Raises
        ------
        AcquisitionError
            The file exists, the folder cannot be written, or the disc has not enough room.
        """
        partial = path.with_name(path.name + PARTIAL)
        # A partial file is whole from the moment it has that name.
        new = path.with_name(path.name + ".new")
        needed = bytes_needed(len(table), len(header.channels), frame_shape)
        if path.exists() or partial.exists():
            raise AcquisitionError(f"{path if path.exists() else partial} exists already; nothing was changed")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            check_space(path.parent, needed)
            _try_room(new, needed)
            h5 = h5py.File(new, "w")
        except OSError as error:
            new.unlink(missing_ok=True)
            if error.errno in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT):
                raise _no_room(path.parent, needed, error) from error
            raise AcquisitionError(
                f"{partial} cannot be created ({error}). Choose another folder with --out."
            ) from error
        try:
            create_layout(h5, header, dict(table.angles_deg), table.role, frame_shape, np.uint16, start_time)
            h5["entry/states/exposure_s"][...] = table.exposure_s
            h5["entry/states/repeats"][...] = table.repeats
            h5.flush()
            _reserve(new)
            os.rename(new, partial)
        except (OSError, RuntimeError) as error:
            _close_quietly(h5)
            new.unlink(missing_ok=True)
            raise _no_room(path.parent, needed, error) from error
        return cls(partial, h5)

    @classmethod
    def reopen(cls, partial: Path) -> CaptureWriter:
        """Open a partial file to go on with it. Raises AcquisitionError."""
        try:
            h5 = h5py.File(partial, "r+")
        except OSError as error:
            raise AcquisitionError(
                f"{partial} cannot be opened to go on ({error}). If another program has it open, end that one."
            ) from error
        return cls(partial, h5)

    def put(self, record: StateRecord) -> None:
        """Hand over a state; waits only while two others wait already."""
        self._raise_error()
        self._queue.put(record)

    def set_exposure(self, exposure_s: NDArray[np.float64]) -> None:
        """Write the exposure of every state; NaN while it is not known. No state may be waiting."""
        self._drain()
        self._h5["entry/states/exposure_s"][...] = exposure_s
        self._h5.flush()

    def forget(self) -> None:
        """Mark every state as not done."""
        self._drain()
        self._h5["entry/states/done"][...] = 0
        self._h5.flush()

    def _drain(self) -> None:
        self._queue.join()
        self._raise_error()

    def seal(self, status: Status, closing: Mapping[str, Any], *, keep_partial: bool = False) -> Path:
        """Write what waits, the closing record and the status; give the file its final name.

        Parameters
        ----------
        keep_partial : leave the name as it is, for a run that can be resumed.

        Returns
        -------
        Path of the file.

        Raises
        ------
        AcquisitionError
            A state could not be written.
        """
        self._finish()
        try:
            write_closing(self._h5, status, closing)
            self._h5.flush()
        finally:
            self._h5.close()
        self._raise_error()
        _sync(self.path)
        if keep_partial:
            return self.path
        final = self.path.with_name(self.path.name.removesuffix(PARTIAL))
        os.rename(self.path, final)
        _sync(final.parent)
        self.path = final
        return final

    def abandon(self) -> None:
        """Write what waits and close, without a closing record; never raises."""
        self._finish()
        _close_quietly(self._h5)

    def _finish(self) -> None:
        if not self._closed:
            self._closed = True
            self._queue.put(None)
            self._thread.join()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise AcquisitionError(
                f"{self.path} could not be written ({self._error}). States done before it are intact; "
                "go on with --resume when the disc is well."
            ) from self._error

    def _work(self) -> None:
        while (record := self._queue.get()) is not None:
            try:
                if self._error is None:
                    self._write(record)
            except (OSError, RuntimeError, ValueError, TypeError) as error:
                # Raised again in the measuring thread by put() or seal().
                self._error = error
            finally:
                self._queue.task_done()

    def _write(self, record: StateRecord) -> None:
        h5, k = self._h5, record.state
        pixels = record.pixels if record.pixels.ndim == 3 else record.pixels[np.newaxis]
        for channel, image in enumerate(pixels):
            # A chunk is a frame: written straight through, without the library's cache.
            h5["entry/instrument/detector/data"].id.write_direct_chunk(
                (k, channel, 0, 0), np.ascontiguousarray(image).tobytes()
            )
        for axis, position in record.positions.items():
            h5[f"entry/instrument/{axis}/value"][k] = position.deg
            h5[f"entry/instrument/{axis}/raw_value"][k] = position.counts
        for name, value in record.columns.items():
            h5[f"entry/states/{name}"][k] = value
        h5.flush()
        h5["entry/states/done"][k] = 1
        h5.flush()


def _try_room(path: Path, needed: int) -> None:
    """Take the space and give it back: a write that fails inside HDF5 would bring the interpreter down."""
    with path.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, needed)


def _no_room(folder: Path, needed: int, error: Exception) -> AcquisitionError:
    return AcquisitionError(
        f"the capture needs {needed:,} bytes in {folder} and cannot get them ({error}; "
        f"{shutil.disk_usage(folder).free:,} free). Nothing was moved. Make room or choose another folder with --out."
    )


def _reserve(path: Path) -> None:
    """Have the file system set the blocks aside: an allocated HDF5 file may still be sparse."""
    with path.open("r+b") as file:
        size = file.seek(0, os.SEEK_END)
        os.posix_fallocate(file.fileno(), 0, size)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _close_quietly(h5: h5py.File) -> None:
    try:
        h5.close()
    except (OSError, RuntimeError):
        # The file is lost already; the error that led here says why.
        return
