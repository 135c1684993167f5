"""A complete capture written anew with its frames compressed: two to three times smaller, every value the same."""

import os
from pathlib import Path

import h5py
import numpy as np

from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.captures.schema import STATE_COLUMNS, STATUS_TYPE, create_layout, put_record
from processing.storage.integrity.checksums import summed_values
from processing.storage.integrity.packing import SMALL_BYTE_WORTH, Packing, create_packed, pack


def pack_capture(path: Path) -> tuple[int, int] | None:
    """Replace a complete capture by its compressed copy, once that has been read back.

    A compressed capture is read like any other, but takes no more states. Its bytes are others, so that products made
    from it before are made anew.

    Returns
    -------
    Bytes before and after; None if it was compressed already.

    Raises
    ------
    CaptureError
        The capture is not complete, is damaged, or has no checksums (nothing would show that the copy is true).
    """
    with Capture(path) as capture, h5py.File(path, "r") as old:
        if old["entry/instrument/detector/data"].compression is not None:
            return None
        if capture.status != "complete" or not capture.checked:
            why = "has no checksums" if capture.status == "complete" else f"is {capture.status}, not complete"
            raise CaptureError(f"{path} {why}: it stays as it is.")
        if capture.damaged_states():
            raise CaptureError(f"{path} is damaged; `acquire verify` tells where. It stays as it is.")
        new = path.with_name(path.name + ".new")
        try:
            _write(capture, old, new)
            _require_same(path, new)
        except BaseException:
            new.unlink(missing_ok=True)
            raise
    sizes = path.stat().st_size, new.stat().st_size
    # On the disc before it replaces what is there.
    with new.open("rb") as file:
        os.fsync(file.fileno())
    os.replace(new, path)
    return sizes


def _write(capture: Capture, old: h5py.File, new: Path) -> None:
    source = old["entry"]
    roles = tuple(role.decode() for role in source["states/role"][...])
    header = capture.header.model_copy(update={"camera_nodes": capture.camera_nodes})
    with h5py.File(new, "w") as h5:
        targets = capture.planned_targets_deg()
        create_layout(
            h5,
            header,
            targets,
            roles,
            frame_shape=capture.frame_shape,
            dtype=capture.dtype,
            start_time=capture.start_time,
            frames=create_packed,
        )
        entry = h5["entry"]
        frames = source["instrument/detector/data"]
        pack(frames, entry["instrument/detector/data"], Packing.of(frames, SMALL_BYTE_WORTH))
        entry["instrument/detector/row_crc32"][...] = source["instrument/detector/row_crc32"][...]
        for axis in targets:
            for name in ("value", "raw_value"):
                entry[f"instrument/{axis}/{name}"][...] = source[f"instrument/{axis}/{name}"][...]
        for name in STATE_COLUMNS:
            if name in source["states"]:
                entry[f"states/{name}"][...] = source[f"states/{name}"][...]
            else:
                # An older file has not this column, and its checksums do not cover it.
                del entry[f"states/{name}"]
        if "sigma" in source["states"]:
            source["states"].copy("sigma", entry["states"], without_attrs=True)
            entry["states/sigma"].attrs["units"] = "count"
        for name in ("segments", "closing"):
            if name in source:
                put_record(entry, name, source[f"{name}/json"][...].tobytes().rstrip(b"\0"))
        entry.attrs.modify("status", np.array(b"complete", dtype=STATUS_TYPE))


def _require_same(path: Path, new: Path) -> None:
    """Read the copy back against the checksums of the states, and against the original. Raises CaptureError."""
    with Capture(path) as was, Capture(new) as copy, h5py.File(path) as old, h5py.File(new) as h5:
        before, after = summed_values(old["entry"]), summed_values(h5["entry"])
        columns = before.keys() == after.keys() and all(
            before[name].tobytes() == after[name].tobytes() for name in before
        )
        if not columns or copy.damaged_states() or copy.closing != was.closing or copy.header != was.header:
            raise CaptureError(
                f"the compressed copy of {path} does not read back as it was written; nothing was changed."
            )
