"""Arrays and lists of frames of other programs: HDF5, .npy, .mat, and folders of pictures."""

from __future__ import annotations

import glob
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from processing.doors import one_line, require_file
from processing.errors import ProcessError
from processing.storage.integrity.h5_door import damage_as, open_h5, read_npy, require_dataset


class ImportFailed(ProcessError):
    """Data measured elsewhere cannot be made into a capture."""


#: Kinds of files with one frame each.
FRAME_SUFFIXES = (".npy", ".png", ".tif", ".tiff")
#: Files with named or single arrays.
ARRAY_SUFFIXES = (".npy", ".mat", ".h5", ".hdf5", ".hdf", ".nxs")
#: FILE, an optional ::NAME, and an optional column [K].
_ADDRESS = re.compile(r"(?P<file>.+?)(?:::(?P<name>[^\[\]]+))?(?:\[(?P<column>\d{1,4})\])?")


def is_array(text: str) -> bool:
    """Whether a text addresses an array in a file, as `FILE::NAME`, `FILE.npy` or `FILE.mat::NAME[K]`."""
    match = _ADDRESS.fullmatch(text)
    return match is not None and (match["name"] is not None or match["file"].lower().endswith(ARRAY_SUFFIXES))


def read_column(text: str) -> NDArray[np.float64]:
    """One number a state from an array in a file.

    Parameters
    ----------
    text : `FILE::NAME` (HDF5, .mat) or `FILE.npy`; `[K]` at its end takes column K of a table.

    Raises
    ------
    ImportFailed : the file, the array or the column cannot be used.
    """
    match = _ADDRESS.fullmatch(text)
    assert match is not None
    values = np.squeeze(open_array(text.removesuffix(f"[{match['column']}]"))[...])
    if values.ndim == 2 and match["column"] is not None:
        if int(match["column"]) >= values.shape[1]:
            raise ImportFailed(f"{text}: the table has {values.shape[1]} columns; the first one is [0]")
        values = values[:, int(match["column"])]
    if values.ndim != 1 or values.dtype.kind not in "uif":
        raise ImportFailed(
            f"{text}: shape {values.shape} of {values.dtype}; one number a state is needed. "
            "Choose a column of a table as FILE::NAME[0]"
        )
    return np.asarray(values, dtype=float)


def open_array(text: str) -> Any:
    """An array with shape, dtype and slices, as `FILE.npy`, `FILE::NAME` of HDF5 or `FILE.mat::NAME`.

    Raises
    ------
    ImportFailed : no such file, no such array, or it is damaged. The message lists the arrays of the file.
    """
    name, _, inside = text.partition("::")
    file = Path(name)
    with damage_as(ImportFailed, f"{text}: cannot be read"):
        require_file(file, ImportFailed)
        if name.endswith(".npy"):
            return read_npy(file, ImportFailed)
        if name.endswith(".mat") and not h5py.is_hdf5(file):
            return _matlab_array(file, inside)
        h5 = open_h5(file, ImportFailed)
        inside = inside or _only_stack(h5, name)
        dataset = require_dataset(h5, inside, (None,) * getattr(h5.get(inside), "ndim", 3), "uif")
        # MATLAB writes its axes in the order of Fortran.
        return dataset[...].T if name.endswith(".mat") else dataset


def frame_files(text: str) -> tuple[Path, ...] | None:
    """The frames of a folder or a pattern such as `run/*.tif`, frame 2 before frame 10; None of a single file.

    Raises
    ------
    ImportFailed : the folder has no frames, or no file is of that pattern.
    """
    folder = Path(text)
    if folder.is_dir():
        files = [f for f in folder.iterdir() if f.suffix.lower() in FRAME_SUFFIXES]
    elif glob.has_magic(text) and not folder.exists():
        files = [Path(f) for f in glob.glob(text)]
    else:
        return None
    if not files:
        raise ImportFailed(f"{one_line(text)}: no frames there ({', '.join(FRAME_SUFFIXES)})")
    return tuple(sorted(files, key=lambda f: [int(p) if p.isdecimal() else p for p in re.split(r"(\d+)", f.name)]))


def states_first(stack: Any, states: int) -> Any:
    """The stack with its states along the first axis; MATLAB's usual order has them along the last one."""
    shape = tuple(stack.shape)
    if len(shape) == 3 and shape[0] != states and shape[-1] == states:
        return np.moveaxis(stack[...], -1, 0)
    return stack


def _matlab_array(file: Path, name: str) -> NDArray[Any]:
    from scipy.io import loadmat, whosmat

    arrays = {n: shape for n, shape, _ in whosmat(file)}
    name = name or (next(iter(arrays)) if len(arrays) == 1 else "")
    if name not in arrays:
        raise ImportFailed(f"{file}: choose an array as {file}::NAME; it has {', '.join(arrays) or 'none'}")
    return np.asarray(loadmat(file, variable_names=[name])[name])


def _only_stack(h5: h5py.File, file: str) -> str:
    found: list[str] = []
    h5.visititems(lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) and item.ndim >= 3 else None)
    if len(found) != 1:
        shown = ", ".join(found) or "none"
        raise ImportFailed(f"{file}: datasets with three or four dimensions: {shown}. Choose one as {file}::/NAME")
    return found[0]
