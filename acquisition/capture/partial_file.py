"""The partial file of a capture: made with all its space, sealed, and states of it taken again.

It is whole from the moment that it has its name; a finished file loses its `.partial`. The disc process does all this.
"""

import contextlib
import errno
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from acquisition.capture.closing import closing_of_killed
from acquisition.capture.layout import put_layout
from acquisition.capture.state_file import StateFile
from acquisition.capture.synced import make_folder, sync
from acquisition.errors import AcquisitionError
from processing.instrument.states import StateTable
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.captures.schema import CaptureHeader, create_layout, json_bytes
from processing.storage.captures.segments import encode_line

PARTIAL = ".partial"
NEW = ".new"
#: Layout, notes and journals besides the frames, and the columns of a state, generously.
LAYOUT_BYTES = 3 << 19
COLUMN_BYTES = 512
ROW_SUM_BYTES = 4


def bytes_needed(states: int, channels: int, frame_shape: tuple[int, int]) -> int:
    """Bytes of a capture file of this size; a count has two."""
    return states * (channels * frame_shape[0] * (2 * frame_shape[1] + ROW_SUM_BYTES) + COLUMN_BYTES) + LAYOUT_BYTES


def check_space(folder: Path, needed: int) -> None:
    """Refuse a disc that is too small. Raises AcquisitionError with the bytes needed and free, or for no folder."""
    if not folder.is_dir():
        raise AcquisitionError(f"{folder} is a file, and captures need a folder. Choose another with --out.")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise AcquisitionError(f"nothing can be written into {folder}. Nothing was moved. Choose another with --out.")
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise AcquisitionError(
            f"the capture needs {needed:,} bytes in {folder}, {free:,} are free. "
            "Nothing was moved. Make room or choose another folder with --out."
        )


def create_partial(
    path: Path,
    header: CaptureHeader,
    table: StateTable,
    frame_shape: tuple[int, int],
    *,
    start_time: str,
    begin: Mapping[str, Any] | None,
) -> Path:
    """Make the partial file, as `CaptureWriter.create` says; returns its path."""
    partial = path.with_name(path.name + PARTIAL)
    # A partial file is whole from the moment it has that name.
    new = path.with_name(path.name + NEW)
    needed = bytes_needed(len(table), len(header.channels), frame_shape)
    if path.exists() or partial.exists():
        raise AcquisitionError(f"{path if path.exists() else partial} exists already; nothing was changed")

    def make(h5: h5py.File) -> None:
        create_layout(
            h5,
            header,
            dict(table.angles_deg),
            table.role,
            frame_shape=frame_shape,
            dtype=np.uint16,
            start_time=start_time,
        )
        h5["entry/states/exposure_s"][...] = table.exposure_s
        h5["entry/states/repeats"][...] = table.repeats

    try:
        make_folder(path.parent)
        check_space(path.parent, needed)
        put_layout(new, needed, make, b"" if begin is None else encode_line(json_bytes(begin)))
        _require_layout(new, table)
        os.rename(new, partial)
        sync(partial.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)
        if error.errno in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT):
            raise _no_room(path.parent, needed, error) from error
        raise AcquisitionError(f"{partial} cannot be created ({error}). Choose another folder with --out.") from error
    return partial


def finish(partial: Path) -> Path:
    """Give a file its final name; returns that."""
    final = partial.with_name(partial.name.removesuffix(PARTIAL))
    os.rename(partial, final)
    sync(final.parent)
    return final


def seal_whole(partial: Path) -> Path | None:
    """Seal a file whose states are all there, but whose run was killed before its end; None if states are missing.

    Raises AcquisitionError: another program has the file open, or it is damaged.
    """
    with Capture(partial) as capture:
        if len(capture.done) < capture.planned_states:
            return None
        complete = capture.status == "complete"
    if not complete:
        with contextlib.closing(StateFile(partial)) as file:
            file.write_closing(closing_of_killed(file.segment_records()))
            file.write_status("complete")
    return finish(partial)


def mark_not_taken(path: Path, states: Sequence[int]) -> Path:
    """Have states of a capture taken again: not done, the capture failed and partial. Returns its name."""
    partial = as_partial(path)
    with contextlib.closing(StateFile(partial)) as file:
        file.write_status("failed")
        for name, value in (("done", 0), ("exposure_s", np.nan)):
            column = file.read_column(name)
            column[list(states)] = value
            file.write_column(name, column)
    return partial


def as_partial(path: Path) -> Path:
    """Give a file that ended in order, but with states missing, its partial name again; returns that."""
    if path.name.endswith(PARTIAL):
        return path
    partial = path.rename(path.with_name(path.name + PARTIAL))
    sync(partial.parent)
    return partial


def _require_layout(path: Path, table: StateTable) -> None:
    """Read a new file back: a disc that lost a write of it says so now, not when the states are there.

    Raises OSError.
    """
    try:
        with Capture(path) as capture:
            columns = capture.planned_targets_deg() | {"exposure_s": capture.planned_column("exposure_s")}
    except CaptureError as error:
        raise OSError(f"the new file does not read back: {error}") from error
    for name, values in {**table.angles_deg, "exposure_s": table.exposure_s}.items():
        if not np.array_equal(columns.get(name, ()), values):
            raise OSError(f"the new file does not read back: {name} is not as it was written")


def _no_room(folder: Path, needed: int, error: Exception) -> AcquisitionError:
    return AcquisitionError(
        f"the capture needs {needed:,} bytes in {folder} and cannot get them ({error}; "
        f"{shutil.disk_usage(folder).free:,} free). Nothing was moved. Make room or choose another folder with --out."
    )
