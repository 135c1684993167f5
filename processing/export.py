"""Captures and products in the formats of other programs: TIFF, CSV, FITS, MATLAB, figures for a paper.

Everything starts from the labelled arrays of `processing.labelled`: states that were not taken are left out, and
checksums are verified. Each file says what its numbers are, in which unit, and whether they are simulated.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from processing.doors import require_place
from processing.errors import ProcessError
from processing.labelled import open_dataset
from processing.storage.product import Product, is_product

if TYPE_CHECKING:
    import xarray as xr

#: Resolution of figures, for print.
FIGURE_DPI = 300
#: What a variable of MATLAB's version 5 files may have.
MATLAB_BYTES = 2**31 - 1


def export(source: Path, to: str, out: Path, planes: Sequence[str] = (), overwrite: bool = False) -> list[Path]:
    """Write a capture or product in another format; returns the files written.

    Parameters
    ----------
    to : one of `FORMATS` or `FIGURES`.
    out : file name, with its ending or without; TIFF adds the name of the plane.
    planes : names of planes; all by default, for a capture `counts`. In CSV a capture is its table of states.

    Raises
    ------
    ProcessError
        The format or a plane is unknown, a file exists, or the format cannot hold the data.
    """
    if to not in (*FORMATS, *FIGURES):
        raise ProcessError(f"unknown format {to!r}; there are: {', '.join((*FORMATS, *FIGURES))}")
    if out.suffix.lower() in (f".{to}", ".tif" if to == "tiff" else None):
        out = out.with_suffix("")
    if to in FIGURES:
        path = out.with_name(f"{out.name}.{to}")
        require_place(path, overwrite)
        _figure(source, path, planes)
        return [path]
    dataset = open_dataset(source)
    names = list(planes) or [str(name) for name in dataset.data_vars]
    unknown = [name for name in names if name not in dataset.data_vars]
    if unknown:
        raise ProcessError(f"{source} has no {unknown[0]!r}; it has: {', '.join(map(str, dataset.data_vars))}")
    return FORMATS[to](dataset, names, out, overwrite)


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
        whole = np.iinfo(dataset[name].dtype).bits <= 16 if dataset[name].dtype.kind in "ui" else False
        images = [Image.fromarray(page if whole else page.astype(np.float32)) for _, page in pages]
        told = _facts(dataset) | dict(dataset[name].attrs) | {"pages": [label for label, _ in pages]}
        size = sum(page.nbytes for _, page in pages)
        images[0].save(
            path, "TIFF", save_all=True, append_images=images[1:], big_tiff=size > 3 << 30,
            description=json.dumps(told, default=str),
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
    with path.open("w", encoding="utf-8") as file:
        for key, value in _facts(dataset).items():
            file.write(f"# {key}: {value}\n")
        for name in (*dataset.coords, *names):
            if units := dataset[name].attrs.get("units"):
                file.write(f"# {name} in {units}\n")
        file.write(",".join(columns) + "\n")
        formats = [_digits(column.dtype) for column in columns.values()]
        rows = np.rec.fromarrays(list(columns.values()))
        np.savetxt(file, rows, fmt=formats, delimiter=",")
    return [path]


def _digits(dtype: np.dtype[Any]) -> str:
    """As many digits as a value has, so that reading it back gives the same."""
    return {"f": "%.9g" if dtype.itemsize <= 4 else "%.17g", "i": "%d", "u": "%d"}.get(dtype.kind, "%s")


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
    fits.HDUList(parts).writeto(path, overwrite=overwrite)
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
    savemat(
        path,
        values | {"about": _facts(dataset), "units": units},
        do_compression=True,
        oned_as="column",
        long_field_names=True,
    )
    return [path]


def _figure(source: Path, path: Path, planes: Sequence[str]) -> None:
    """The figure of a product, or maps of some planes in the same colours, sharp enough to print.

    Elements of a Mueller matrix mean something over m00 alone: they are the product's own figure.
    """
    from processing.reports.colours import scale_of
    from processing.reports.figure_style import grid_figure
    from processing.reports.figures import product_figure

    if not is_product(source):
        raise ProcessError(f"{source} is no image; figures are made of products (`process reduce` makes one).")
    with Product(source) as product:
        if not planes or (list(planes) == ["mueller"] and product.kind == "mueller"):
            figure = product_figure(product)
        else:
            known = _known(product)
            panels: list[tuple[str, NDArray[Any], dict[str, Any]]] = []
            for name in planes:
                values = product.get(name)
                unit = f" ({product.units(name)})" if product.units(name) else ""
                for index in np.ndindex(*values.shape[:-2]):
                    place = "".join(str(k) for k in index)
                    shown = values[index] if name in MASKS else np.where(known, values[index], np.nan)
                    scale = scale_of(name, product.units(name), shown)
                    limits = {"cmap": scale.colours, "vmin": scale.low, "vmax": scale.high}
                    panels.append((f"{name.replace('_', ' ')}{' ' + place if place else ''}{unit}", shown, limits))
            figure = grid_figure(panels, product.header.title, product.simulated)
    figure.savefig(path, dpi=FIGURE_DPI)


def _known(product: Product) -> NDArray[np.bool_]:
    """Where a product's own mask says that its values mean something; everywhere without one."""
    known = np.ones(product.shape, dtype=bool)
    for name in MASKS:
        if name in product.names:
            known &= product.get(name) > 0
    return known


#: Planes that say where the others hold.
MASKS = ("valid", "lit")
#: Formats that are pictures, and those that are numbers.
FIGURES = ("png", "pdf")
FORMATS: dict[str, Callable[[Any, list[str], Path, bool], list[Path]]] = {
    "tiff": _to_tiff,
    "csv": _to_csv,
    "fits": _to_fits,
    "mat": _to_matlab,
}
