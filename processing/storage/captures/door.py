"""What a capture file must hold before any of it is believed."""

import h5py
import numpy as np

from processing.doors import MOST_PIXELS
from processing.storage.captures.schema import STATE_COLUMNS, CaptureHeader
from processing.storage.integrity.h5_door import MOST_STATES, require_dataset, require_group

STATUSES = ("running", "complete", "aborted", "failed")
#: Columns that the first version of the format did not have.
LATER_COLUMNS = ("segment", "crc32", "camera_temperature_c", "full_scale_counts")
ROLES = ("dark", "flat", "air", "sample")


def check_capture(entry: h5py.Group, header: CaptureHeader) -> None:
    """Look at every part that a reader relies on. Raises ValueError with the first that is not as it should be."""
    status = entry.attrs["status"]
    if (status.decode() if isinstance(status, bytes) else status) not in STATUSES:
        raise ValueError(f"the status {status!r} is none of {', '.join(STATUSES)}")
    states = require_group(entry, "states")
    n = int(require_dataset(states, "done", (None,), "u").shape[0])
    if n > MOST_STATES:
        raise ValueError(f"{n} states; at most {MOST_STATES} are read")
    for name, kind in STATE_COLUMNS.items():
        if name in states or name not in LATER_COLUMNS:
            require_dataset(states, name, (n,), np.dtype(kind).kind)
    if np.any(states["done"][...] > 1):
        raise ValueError("states/done holds other values than 0 and 1")
    roles = {role.decode() for role in require_dataset(states, "role", (n,), "OS")[...]}
    unknown = sorted(roles - set(ROLES))
    if unknown:
        raise ValueError(f"states/role holds {unknown[0]!r}, none of {', '.join(ROLES)}")
    for name, group in require_group(entry, "instrument").items():
        if isinstance(group, h5py.Group) and group.attrs.get("NX_class") == "NXpositioner":
            for column in ("value", "target_value"):
                require_dataset(entry["instrument"], f"{name}/{column}", (n,), "f")
    frames = require_dataset(entry["instrument/detector"], "data", (n, len(header.channels), None, None), "uif")
    rows, columns = (int(size) for size in frames.shape[2:])
    if "row_crc32" in entry["instrument/detector"]:
        require_dataset(entry["instrument/detector"], "row_crc32", (n, len(header.channels), rows), "u")
    if not 0 < rows * columns <= MOST_PIXELS:
        raise ValueError(f"frames of {rows} x {columns} pixels; at most {MOST_PIXELS:,} pixels are read")
