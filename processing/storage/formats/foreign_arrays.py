"""Arrays and lists of frames of other programs: HDF5, .npy, .mat, and folders of pictures."""

import glob
import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from processing.doors import one_line, read_text_of_any_system, require_file
from processing.errors import ProcessError
from processing.storage.integrity.h5_door import damage_as, open_h5, read_npy, read_npz, require_dataset


class ImportFailed(ProcessError):
    """Data measured elsewhere cannot be made into a capture."""


#: Kinds of files with one frame each.
FRAME_SUFFIXES = (".npy", ".png", ".tif", ".tiff")
#: Files with named or single arrays.
ARRAY_SUFFIXES = (".npy", ".npz", ".mat", ".h5", ".hdf5", ".hdf", ".nxs")
#: Text files with numbers in columns, without names.
TEXT_SUFFIXES = (".txt", ".dat", ".csv", ".tsv")
#: FILE, an optional ::NAME, and an optional column [K] or [FIELD].
_ADDRESS = re.compile(r"(?P<file>.+?)(?:::(?P<name>[^\[\]]+))?(?:\[(?P<column>[^\[\]]{1,80})\])?")
#: A part of a pattern of file names that has the numbers of an axis, as `G{psg}_A{psa}.tif`.
_IN_NAME = re.compile(r"\{([A-Za-z]\w*)\}")
_NUMBER = r"([-+]?\d{1,9}(?:[.,]\d{1,9})?)"


def is_array(text: str) -> bool:
    """Whether a text addresses an array in a file, as `FILE::NAME`, `FILE.npy` or `FILE.mat::NAME[K]`."""
    match = _ADDRESS.fullmatch(text)
    if match is None:
        return False
    return match["name"] is not None or match["file"].lower().endswith(ARRAY_SUFFIXES + TEXT_SUFFIXES)


def read_column(text: str) -> NDArray[np.float64]:
    """One number a state from an array in a file.

    Parameters
    ----------
    text : `FILE::NAME` (HDF5, .mat, .npz) or `FILE.npy`; `[K]` at its end takes column K of a table.

    Raises
    ------
    ImportFailed : the file, the array or the column cannot be used.
    """
    match = _ADDRESS.fullmatch(text)
    assert match is not None
    column = match["column"]
    with damage_as(ImportFailed, f"{text}: cannot be read"):
        if match["file"].lower().endswith(TEXT_SUFFIXES):
            values: NDArray[Any] = _text_table(Path(match["file"]))
        else:
            values = np.squeeze(open_array(text.removesuffix(f"[{column}]"), "uifV")[...])
    if values.dtype.names is not None and column in values.dtype.names:
        values = values[str(column)]
    elif values.ndim == 2 and column is not None and column.isdecimal():
        # A table has more states than columns.
        table = values.T if values.shape[0] < values.shape[1] else values
        if int(column) >= table.shape[1]:
            raise ImportFailed(f"{text}: the table has {table.shape[1]} columns; the first one is [0]")
        values = table[:, int(column)]
    if values.ndim != 1 or values.dtype.kind not in "uif":
        first = "0" if values.dtype.names is None else values.dtype.names[0]
        fields = f" ({', '.join(values.dtype.names)})" if values.dtype.names else ""
        raise ImportFailed(
            f"{text}: shape {values.shape} of {values.dtype.name}{fields}; one number a state is needed. "
            f"Choose a column of a table as '{text.removesuffix(f'[{column}]')}[{first}]'"
        )
    return np.asarray(values, dtype=float)


def stated_unit(text: str) -> str:
    """Source of the unit of numbers: the header of a column, or the attribute `units` of a dataset."""
    if not is_array(text):
        return text
    match = _ADDRESS.fullmatch(text)
    if match is None or match["file"].lower().endswith((".npy", ".mat", *TEXT_SUFFIXES)):
        return match["column"] or "" if match else ""
    attributes = getattr(open_array(text.removesuffix(f"[{match['column']}]"), "uifV"), "attrs", {})
    return f"{match['column'] or ''} {attributes.get('units', attributes.get('unit', ''))}"


def _text_table(file: Path) -> NDArray[np.float64]:
    """Numbers of a text file without names: (rows,) or (rows, columns)."""
    lines = [line for line in read_text_of_any_system(file, ImportFailed).splitlines() if line.strip("\ufeff \t")]
    lines = [line for line in lines if not line.lstrip().startswith("#")]
    delimiter = next((d for d in ";\t" if lines and d in lines[0]), None)
    if delimiter is None and lines and "," in lines[0]:
        delimiter = ","
    else:
        lines = [line.replace(",", ".") for line in lines]
    return np.asarray(np.loadtxt(lines, delimiter=delimiter, ndmin=1, comments=None))


def open_array(text: str, kinds: str = "uif") -> Any:
    """An array with shape, dtype and slices, as `FILE.npy`, or `FILE::NAME` of HDF5, .npz or .mat.

    A field of a MATLAB struct is `FILE.mat::STRUCT.FIELD`.

    Parameters
    ----------
    kinds : letters of numpy for the types that are allowed in HDF5.

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
        if name.endswith(".npz"):
            return _of_archive(file, inside)
        if name.endswith(".mat") and not h5py.is_hdf5(file):
            return _matlab_array(file, inside)
        h5 = open_h5(file, ImportFailed)
        if name.endswith(".mat"):
            inside = inside.replace(".", "/")
        inside = inside or _only_stack(h5, name)
        if inside not in h5:
            raise ImportFailed(f"{file}: no dataset {inside!r}; it has {_names_text(_datasets(h5))}")
        dataset = require_dataset(h5, inside, (None,) * getattr(h5.get(inside), "ndim", 3), kinds)
        # MATLAB writes its axes in the order of Fortran.
        return dataset[...].T if name.endswith(".mat") else dataset


@dataclass(frozen=True)
class FrameFiles:
    """Files with frames, in natural order, and the numbers that their names have: name to (N,)."""

    files: tuple[Path, ...]
    numbers: dict[str, NDArray[np.float64]]


def frame_files(text: str) -> FrameFiles | None:
    """The frames of a folder or a pattern such as `run/*.tif`, frame 2 before frame 10; None of a single file.

    A pattern may have names of axes, as `run/G{psg}_A{psa}.tif`: the file names then have the angles. Raises
    ImportFailed: the folder has no frames, or no file is of that pattern.
    """
    folder, numbers = Path(text), {}
    if folder.is_dir():
        files = [f for f in folder.iterdir() if f.suffix.lower() in FRAME_SUFFIXES]
    elif glob.has_magic(text) and not folder.exists():
        files = [Path(f) for f in glob.glob(text)]
    elif _IN_NAME.search(folder.name) and not folder.exists():
        parts = _IN_NAME.split(folder.name)
        pattern = re.compile("".join(_NUMBER if k % 2 else re.escape(part) for k, part in enumerate(parts)))
        entries = folder.parent.iterdir() if folder.parent.is_dir() else ()
        files = _naturally([f for f in entries if pattern.fullmatch(f.name)])
        texts = [pattern.fullmatch(f.name).groups() for f in files]  # type: ignore[union-attr]
        numbers = {
            name: np.array([float(row[k].replace(",", ".")) for row in texts]) for k, name in enumerate(parts[1::2])
        }
    else:
        return None
    if not files:
        raise ImportFailed(f"{one_line(text)}: no frames there ({', '.join(FRAME_SUFFIXES)})")
    return FrameFiles(tuple(_naturally(files)), numbers)


def _naturally(files: list[Path]) -> list[Path]:
    return sorted(files, key=lambda f: [int(p) if p.isdecimal() else p for p in re.split(r"(\d+)", str(f))])


def missing_numbers(files: Sequence[Path]) -> str:
    """Numbers that the names of files leave out, as text; empty where the names are not numbered."""
    digits = [re.findall(r"\d{1,9}", f.stem) for f in files]
    numbers = {int(n[-1]) for n in digits if n}
    if len(numbers) < len(files) or max(numbers) - min(numbers) > 2 * len(files):
        return ""
    return ", ".join(str(n) for n in range(min(numbers), max(numbers)) if n not in numbers)


def states_first(stack: Any, states: int | None, frame: tuple[int, int] | None = None) -> Any:
    """The stack with its states along the first axis; MATLAB's usual order has them along the last one."""
    shape = tuple(stack.shape)
    if len(shape) != 3:
        return stack
    of_count = shape[-1] == states and shape[0] != states
    of_frame = frame is not None and shape[:2] == frame and shape[-2:] != frame
    return np.moveaxis(stack[...], -1, 0) if of_count or of_frame else stack


def _matlab_array(file: Path, name: str) -> NDArray[Any]:
    from scipy.io import loadmat, whosmat

    arrays = [n for n, _, _ in whosmat(file)]
    name = name or (arrays[0] if len(arrays) == 1 else "")
    first, *fields = name.split(".")
    _require_array(file, first, arrays)
    values = np.asarray(loadmat(file, variable_names=[first])[first])
    while values.dtype.names is not None and values.size == 1:
        # A struct: an array of one record, whose fields are arrays again.
        inside = [f"{first}.{field}" for field in values.dtype.names]
        first = f"{first}.{fields.pop(0)}" if fields else ""
        _require_array(file, first, inside)
        values = np.asarray(values[first.rpartition(".")[2]].item())
    if fields or values.dtype.kind not in "uif":
        raise ImportFailed(f"{file}: {name} holds {values.dtype.name}, not an array of numbers")
    return values


def _of_archive(file: Path, name: str) -> NDArray[Any]:
    try:
        arrays = [n.removesuffix(".npy") for n in zipfile.ZipFile(file).namelist()]
    except zipfile.BadZipFile as why:
        raise ImportFailed(f"{file}: is no .npz file ({one_line(why)})") from why
    name = name.lstrip("/") or (arrays[0] if len(arrays) == 1 else "")
    _require_array(file, name, arrays)
    return read_npz(file, name, ImportFailed)


def _require_array(file: Path, name: str, arrays: Sequence[str]) -> None:
    if name not in arrays:
        missing = f"no array {name!r}; " if name else ""
        raise ImportFailed(f"{file}: {missing}it has {_names_text(arrays)}. Choose one as {file}::NAME")


def _names_text(names: Sequence[str]) -> str:
    return one_line(", ".join(names), 300) or "none"


def _datasets(h5: h5py.File, dimensions: int = 0) -> list[str]:
    names: list[str] = []

    def look(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset) and item.ndim >= dimensions:
            names.append(f"/{name}")

    h5.visititems(look)
    return names


def _only_stack(h5: h5py.File, file: str) -> str:
    stacks = _datasets(h5, 3)
    if len(stacks) != 1:
        raise ImportFailed(
            f"{file}: datasets with three or four dimensions: {_names_text(stacks)}. Choose one as {file}::/NAME"
        )
    return stacks[0]
