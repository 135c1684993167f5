"""Frames that stay in files, and the documents that point to them."""

import datetime
import itertools
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

Documents = Iterator[tuple[str, dict[str, Any]]]

#: Of a single frame in its file.
FRAME = "/entry/data/frame"


def write_frame(folder: Path, name: str, frame: NDArray[np.uint16], exposure_s: float) -> Path:
    """Put one frame into a NeXus file of its own, as (1, row, column), and return its path. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    stem = f"{datetime.datetime.now():%Y%m%d-%H%M%S}_{name}"
    for number in itertools.count(1):
        path = folder / f"{stem}-{number:03d}.h5"
        try:
            # Refuses an existing name, also one that another program creates at this moment.
            h5 = h5py.File(path, "x")
        except FileExistsError:
            continue
        with h5:
            h5.attrs["default"] = "entry"
            entry = h5.create_group("entry")
            entry.attrs.update(NX_class="NXentry", default="data")
            data = entry.create_group("data")
            data.attrs.update(NX_class="NXdata", signal="frame")
            data["frame"] = frame[None]
            data["frame"].attrs["units"] = "count"
            data["exposure_s"] = exposure_s
            data["exposure_s"].attrs["units"] = "s"
        return path
    raise AssertionError("numbers do not end")


def asset_documents(key: str, path: Path, dataset: str, chunk: tuple[int, ...]) -> Documents:
    """Say that a dataset of an HDF5 file is the value of a data key in one event.

    Each file is a resource of its own: an event that a RunEngine takes again after a pause then loses nothing of those
    before it.

    Parameters
    ----------
    key : data key of the event.
    chunk : shape of the pieces in which it is best read.
    """
    resource = str(uuid.uuid4())
    yield (
        "stream_resource",
        {
            "uid": resource,
            "data_key": key,
            "mimetype": "application/x-hdf5",
            "uri": path.resolve().as_uri().replace("file:///", "file://localhost/"),
            "parameters": {"dataset": dataset, "swmr": False, "chunk_shape": chunk},
        },
    )
    yield (
        "stream_datum",
        {
            "uid": f"{resource}/0",
            "stream_resource": resource,
            "descriptor": "",
            "indices": {"start": 0, "stop": 1},
            "seq_nums": {"start": 0, "stop": 0},
        },
    )


def external_key(key: dict[str, Any]) -> dict[str, Any]:
    """A data key whose counts are found through a stream resource."""
    return key | {"external": "STREAM:", "dtype_numpy": "<u2"}
