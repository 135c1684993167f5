"""Captures and products as numbers for other programs: TIFF, CSV, FITS, MATLAB."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from processing.doors import require_place
from processing.errors import ProcessError
from processing.export.csv_file import write_csv
from processing.whole_file import whole_file

if TYPE_CHECKING:
    import xarray as xr

#: What a variable of MATLAB's version 5 files may have.
MATLAB_BYTES = 2**31 - 1

#: Text of 116 bytes at the beginning of such a file; MATLAB reads its first word.
MATLAB_HEADER = b"MATLAB 5.0 MAT-file, written by umov".ljust(116)


def _facts(dataset: xr.Dataset) -> dict[str, Any]:
    """Attributes of a file: what a person wants to know, without the whole header."""
    return {str(name): value for name, value in dataset.attrs.items() if name != "header"}


def _pages(dataset: xr.Dataset, name: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """The images (rows, columns) of a variable, each with its indices, as in m01 of (row 0, column 1)."""
    array = dataset[name]
    leading = array.shape[:-2]
    for index in np.ndindex(*leading):
        label = ", ".join(f"{dim} {k}" for dim, k in zip(array.dims, index, strict=False))
        yield label, array.values[index]


def _to_tiff(dataset: xr.Dataset, names: list[str], out: Path, overwrite: bool) -> list[Path]:
    """One file for each variable, a page for each image; float32 or the camera's integers."""
    from PIL import Image

    paths = [out.with_name(f"{out.name}.{name}.tif") for name in names]
    for path in paths:
        require_place(path, overwrite)
    for name, path in zip(names, paths, strict=True):
        pages = list(_pages(dataset, name))
        is_small = np.iinfo(dataset[name].dtype).bits <= 16 if dataset[name].dtype.kind in "ui" else False
        images = [Image.fromarray(page if is_small else page.astype(np.float32)) for _, page in pages]
        description = _facts(dataset) | dict(dataset[name].attrs) | {"pages": [label for label, _ in pages]}
        size = sum(page.nbytes for _, page in pages)
        with whole_file(path) as new:
            images[0].save(
                new, "TIFF", save_all=True, append_images=images[1:], big_tiff=size > 3 << 30,
                description=json.dumps(description, default=str),
            )  # fmt: skip
    return paths


def _to_csv(dataset: xr.Dataset, names: list[str], out: Path, overwrite: bool) -> list[Path]:
    """A row for each state of a capture, or for each pixel of a product; comments tell units."""
    path = out.with_name(f"{out.name}.csv")
    require_place(path, overwrite)
    columns: dict[str, NDArray[Any]] = {}
    if "state" in dataset.dims:
        columns = {str(name): array.values for name, array in dataset.coords.items() if array.dims == ("state",)} | {
            "mean_counts": dataset["counts"].mean(("channel", "y", "x")).values
        }
    else:
        y, x = np.meshgrid(dataset["y"], dataset["x"], indexing="ij")
        columns = {"y": y.ravel(), "x": x.ravel()}
        for name in names:
            for label, page in _pages(dataset, name):
                columns[name + "".join(f"_{word.split()[-1]}" for word in label.split(", ") if word)] = page.ravel()
    units = {str(name): str(dataset[name].attrs.get("units", "")) for name in (*dataset.coords, *names)}
    write_csv(path, _facts(dataset), units, columns)
    return [path]


def _to_fits(dataset: xr.Dataset, names: list[str], out: Path, overwrite: bool) -> list[Path]:
    """An image extension for each variable, x fastest; a capture has its table of states as well."""
    try:
        from astropy.io import fits
    except ImportError as error:
        raise ProcessError("FITS needs astropy: pip install 'umov[export]'") from error
    path = out.with_name(f"{out.name}.fits")
    require_place(path, overwrite)
    first = fits.PrimaryHDU()
    for key, value in _facts(dataset).items():
        first.header.add_comment(f"{key}: {value}".encode("ascii", "replace").decode().replace("\n", " "))
    parts: list[Any] = [first]
    for name in names:
        part = fits.ImageHDU(dataset[name].values, name=name)
        part.header["BUNIT"] = dataset[name].attrs.get("units", "")
        part.header.add_comment("axes, slowest first: " + ", ".join(map(str, dataset[name].dims)))
        parts.append(part)
    if "state" in dataset.dims:
        table = [
            fits.Column(name=str(name), array=array.values.astype("S16") if array.dtype.kind in "OU" else array.values,
                        format="16A" if array.dtype.kind in "OU" else "D")
            for name, array in dataset.coords.items() if array.dims == ("state",)
        ]  # fmt: skip
        parts.append(fits.BinTableHDU.from_columns(table, name="states"))
    with whole_file(path) as new:
        fits.HDUList(parts).writeto(new)
    return [path]


def _to_matlab(dataset: xr.Dataset, names: list[str], out: Path, overwrite: bool) -> list[Path]:
    """One .mat file of version 5 with a variable for each plane and coordinate, and `about`."""
    from scipy.io import savemat

    path = out.with_name(f"{out.name}.mat")
    require_place(path, overwrite)
    large = [name for name in names if dataset[name].nbytes > MATLAB_BYTES]
    if large:
        raise ProcessError(
            f"{large[0]} is larger than a variable of this format can be. MATLAB reads the file itself: "
            f"h5read(FILE, '/entry/data/{large[0]}')"
        )
    values = {name: dataset[name].values for name in names}
    values |= {
        str(name): array.values.astype(str) if array.dtype.kind in "OU" else array.values
        for name, array in dataset.coords.items()
    }
    units = {name: str(dataset[name].attrs.get("units", "")) for name in names}
    with whole_file(path) as new:
        savemat(
            new,
            values | {"about": _facts(dataset), "units": units},
            do_compression=True,
            oned_as="column",
            long_field_names=True,
        )
        # SciPy puts the date there. The same product gives the same bytes, and `process export` then skips the file.
        with new.open("r+b") as file:
            file.write(MATLAB_HEADER)
    return [path]


FORMATS: dict[str, Callable[[Any, list[str], Path, bool], list[Path]]] = {
    "tiff": _to_tiff,
    "csv": _to_csv,
    "fits": _to_fits,
    "mat": _to_matlab,
}
