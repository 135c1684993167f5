"""A capture file from labelled arrays (xarray)."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from processing.doors import require_new
from processing.errors import ProcessError
from processing.storage.captures.schema import CaptureHeader, create_layout, write_closing

if TYPE_CHECKING:
    import xarray as xr


def write_dataset(dataset: xr.Dataset, path: Path | str) -> Path:
    """Write a Dataset as `open_dataset` gives it for a capture into a capture file.

    Needed are `counts` (state, channel, y, x), one `AXIS_deg` (state) for each axis that turned, and the attribute
    `header` (JSON of a `CaptureHeader`) or `wavelength_nm` and `title`. Without `role` all states are of the sample.

    Parameters
    ----------
    dataset : xarray.Dataset
        Counts; angles in degrees, exposures in seconds.
    path : path or str

    Returns
    -------
    Path
        Of the file.

    Raises
    ------
    ProcessError
        The file exists, or something needed is missing.

    Examples
    --------
    >>> import numpy as np
    >>> import xarray as xr
    >>> angle = np.arange(0, 360, 9.0)
    >>> frames = np.full((40, 1, 8, 12), 900, np.uint16)
    >>> turned = {"psg_deg": ("state", angle), "psa_deg": ("state", 5 * angle)}
    >>> made = xr.Dataset(
    ...     {"counts": (("state", "channel", "y", "x"), frames)} | turned,
    ...     attrs={"wavelength_nm": 532, "title": "white card"},
    ... )
    >>> print(write_dataset(made, "card.h5"))
    card.h5
    """
    path = Path(path)
    require_new(path)
    if "counts" not in dataset or dataset["counts"].dims != ("state", "channel", "y", "x"):
        raise ProcessError("a capture needs a variable `counts` with the dimensions (state, channel, y, x)")
    counts = dataset["counts"].to_numpy()
    header = _header(dataset)
    angles = {
        str(name).rpartition("_")[0]: np.asarray(column, dtype=float)
        for name, column in dataset.coords.items()
        if str(name).endswith(("_deg", "_V")) and column.dims == ("state",)
    }
    n = len(counts)
    role = tuple(dataset["role"].to_numpy().astype(str)) if "role" in dataset.coords else ("sample",) * n
    import h5py

    with h5py.File(path, "x") as h5:
        now = datetime.now(UTC).isoformat(timespec="seconds")
        create_layout(h5, header, angles, role, frame_shape=counts.shape[2:], dtype=counts.dtype, start_time=now)
        h5["entry/instrument/detector/data"][...] = counts
        for axis, values in angles.items():
            h5[f"entry/instrument/{axis}/value"][...] = values
        states = h5["entry/states"]
        states["exposure_s"][...] = dataset["exposure_s"].to_numpy() if "exposure_s" in dataset.coords else np.nan
        states["repeats"][...] = 1
        states["done"][...] = 1
        write_closing(h5, "complete", {"source": "written from labelled arrays"})
    return path


def _header(dataset: xr.Dataset) -> CaptureHeader:
    if "header" in dataset.attrs:
        return CaptureHeader.model_validate_json(dataset.attrs["header"])
    missing = [name for name in ("title", "wavelength_nm") if name not in dataset.attrs]
    if missing:
        raise ProcessError(f"a capture needs the attribute {missing[0]!r}, or a whole `header`")
    return CaptureHeader(
        title=str(dataset.attrs["title"]),
        wavelength_nm=float(dataset.attrs["wavelength_nm"]),
        simulated=bool(dataset.attrs.get("simulated", False)),
        mode="labelled",
        channels=tuple(dataset["channel"].to_numpy().astype(str)) if "channel" in dataset.coords else ("camera",),
    )
