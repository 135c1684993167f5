"""Captures and products as labelled arrays (xarray), with coordinates, units and standard errors; and back."""

from __future__ import annotations

import tempfile
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.errors import ProcessError
from processing.extras import needed
from processing.maps.means import mean_of
from processing.maps.region import parse_region
from processing.steps.reduction import Reduction
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import CaptureHeader, position_column
from processing.storage.products.product import Product, is_product, leading_dimensions

if TYPE_CHECKING:
    import xarray as xr


def open_dataset(path: Path | str) -> xr.Dataset:
    """A capture or a product as an xarray Dataset, all of it in memory.

    A capture has `counts` (state, channel, y, x) with coordinates `role`, `exposure_s`, `time` and one `AXIS_deg` for
    each axis, as read back. A product has its planes, (row, column, y, x) for Mueller matrices; `NAME_errors` are
    standard errors. Every variable has `units` and `long_name`; attributes hold title, wavelength, Omega, and whether
    the data are simulated.

    Parameters
    ----------
    path : path or str

    Returns
    -------
    xarray.Dataset

    Raises
    ------
    ProcessError
        The file is neither a capture nor a product, or it is damaged.

    Examples
    --------
    >>> counts = open_dataset("sphere.h5").counts
    >>> dict(counts.sizes), counts.units
    ({'state': 42, 'channel': 1, 'y': 24, 'x': 32}, 'count')
    """
    needed("xarray", "xarray")
    path = Path(path)
    return _of_product(path) if is_product(path) else _of_capture(path)


def open_campaign(folder: Path | str, kind: str = "mueller") -> xr.Dataset:
    """All products of one kind in a folder as one Dataset; images are read when they are used.

    Parameters
    ----------
    folder
        Folder with products, and its subfolders.
    kind
        Kind of product: "mueller", "stokes", "xi0", "quantities" ...

    Returns
    -------
    Dataset
        Floating-point planes with the dimensions (sample, wavelength, omega, repeat), then those of one product.
        `wavelength` is in nm, `omega` in degrees (NaN: not known). Repeats are in the order of their file names. A
        combination that was not measured is NaN. `file` (sample, wavelength, omega, repeat) names the products.

    Raises
    ------
    ProcessError
        There is no product of that kind, or the images have different sizes.

    Examples
    --------
    The median of m11 over the arm angle:

    >>> for name in ("sphere.h5", "sphere_60.h5"):
    ...     _ = Reduction(name).make()
    >>> stack = open_campaign(".")
    >>> m11 = stack.mueller.sel(row=1, column=1) / stack.mueller.sel(row=0, column=0)
    >>> median = m11.median(["y", "x"]).squeeze()
    >>> median.dims, median.omega.values.tolist()
    (('omega',), [35.0, 60.0])
    """
    needed("xarray", "xarray")
    import xarray as xr

    files = [path for path in sorted(Path(folder).rglob("*.h5")) if is_product(path)]
    places: dict[tuple[str, float, float], list[Path]] = {}
    first: tuple[Path, tuple[int, int]] | None = None
    for path in files:
        with Product(path) as product:
            if product.kind != kind:
                continue
            header, sample = product.header, product.header.sample
            first = first or (path, product.shape)
            if product.shape != first[1]:
                raise ProcessError(
                    f"{path}: {product.shape} pixels, but {first[0]} has {first[1]}. Give images of one size"
                )
        omega = np.nan if header.omega_deg is None else header.omega_deg
        places.setdefault((sample.name or sample.kind, header.wavelength_nm, omega), []).append(path)
    if first is None:
        raise ProcessError(f"{folder}: no product of kind {kind!r}. Make them: umov process reduce {folder}")
    # NaN is not equal to itself: angles are compared as text.
    axes = [sorted({str(place[k]): place[k] for place in places}.items(), key=lambda item: item[1]) for k in range(3)]
    shape = (*(len(axis) for axis in axes), max(len(paths) for paths in places.values()))
    grid = np.full(shape, "", dtype=object)
    for place, paths in places.items():
        where = tuple([text for text, _ in axis].index(str(value)) for axis, value in zip(axes, place, strict=True))
        grid[where][: len(paths)] = [str(path) for path in paths]
    example = _of_product(first[0])
    leading = ("sample", "wavelength", "omega", "repeat")
    variables = {
        str(name): ((*leading, *plane.dims), _on_demand(grid, str(name), plane.dtype, plane.shape), plane.attrs)
        for name, plane in example.data_vars.items()
        if plane.dtype.kind == "f"
    }
    coords: dict[str, Any] = {
        "sample": [value for _, value in axes[0]],
        "wavelength": ("wavelength", [value for _, value in axes[1]], {"units": "nm"}),
        "omega": ("omega", [value for _, value in axes[2]], {"units": "degree"}),
        "file": (leading, grid.astype(str)),
    }
    attributes = {"kind": kind, "simulated": example.attrs["simulated"]}
    return xr.Dataset(variables, coords | dict(example.coords), attributes)


def follow_region(folder: Path | str, region: str | None = None, kind: str = "mueller") -> xr.Dataset:
    """Means of one region in every Mueller or Stokes image of a folder, as `process mean` gives them.

    Parameters
    ----------
    folder
        Folder with products, and its subfolders.
    region
        Pixels as "r0:r1,c0:c1"; default: the middle half of the image.
    kind
        "mueller" or "stokes".

    Returns
    -------
    Dataset
        `value`, `u_noise` and `u_systematic` over (file, quantity), with the coordinates `sample`, `wavelength` in nm,
        `omega` in degrees and `time` of the capture. `u_systematic` is what the instrument leaves uncertain.

    Raises
    ------
    ProcessError
        There is no product of that kind, or no pixel of a region can be used.

    Examples
    --------
    >>> for name in ("sphere.h5", "sphere_60.h5"):
    ...     _ = Reduction(name).make()
    >>> found = follow_region(".", "4:12,8:16").sel(quantity="m11_over_m00")
    >>> found.omega.values.tolist(), found.value.dims
    ([35.0, 60.0], ('file',))
    """
    needed("xarray", "xarray")
    import xarray as xr

    lines: list[tuple[Any, ...]] = []
    names: list[str] = []
    for path in (path for path in sorted(Path(folder).rglob("*.h5")) if is_product(path)):
        with Product(path) as product:
            if product.kind != kind:
                continue
            header, time = product.header, taken_at(product)
            place = parse_region(region, product.shape)
        means = mean_of([path], place)
        names = names or [mean.name for mean in means]
        if [mean.name for mean in means] != names:
            raise ProcessError(f"{path}: its instrument determines other quantities than that of {lines[0][0]}")
        sample = header.sample.name or header.sample.kind
        omega = np.nan if header.omega_deg is None else header.omega_deg
        moment = datetime.fromisoformat(time).astimezone(UTC).replace(tzinfo=None) if time else "NaT"
        stamp = np.datetime64(moment, "ns")
        lines.append((str(path), sample, header.wavelength_nm, omega, stamp, means))
    if not lines:
        raise ProcessError(f"{folder}: no product of kind {kind!r}. Make them: umov process reduce {folder}")
    file, *columns, all_means = zip(*lines, strict=True)
    labels = ("sample", "wavelength", "omega", "time")
    coords = {label: ("file", list(column)) for label, column in zip(labels, columns, strict=True)}
    data = {
        name: (("file", "quantity"), [[getattr(mean, name) for mean in means] for means in all_means])
        for name in ("value", "u_noise", "u_systematic")
    }
    return xr.Dataset(data, {"file": list(file), "quantity": names, **coords})


def taken_at(product: Product) -> str:
    """When the capture of a product was begun (ISO 8601); empty where the capture is no longer where it was."""
    for identity in product.steps[0].inputs if product.steps else ():
        path = Path(str(identity.get("path", "")))
        if identity.get("role") == "capture":
            with suppress(ProcessError), Capture(path) as capture:
                return capture.start_time
    return ""


def _on_demand(grid: Any, name: str, dtype: Any, plane: tuple[int, ...]) -> Any:
    """A plane of the products of a grid, as an array that reads what is used of it."""
    from xarray.backends import BackendArray
    from xarray.core import indexing

    class Stack(BackendArray):
        """Planes of many products."""

        def __init__(self) -> None:
            self.shape, self.dtype = (*grid.shape, *plane), np.dtype(dtype)

        def __getitem__(self, key: Any) -> Any:
            return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read)

        def _read(self, key: tuple[Any, ...]) -> Any:
            files, inner = np.asarray(_outer(grid, key[: grid.ndim])), key[grid.ndim :]
            parts = [self._plane(str(file), inner) for file in files.reshape(-1)]
            return np.stack(parts).reshape(*files.shape, *parts[0].shape)

        def _plane(self, file: str, key: tuple[Any, ...]) -> Any:
            if not file:
                return _outer(np.broadcast_to(np.asarray(np.nan, dtype), plane), key)
            rows = key[-2]
            in_block = isinstance(rows, slice) and rows.step in (1, None)
            with Product(file) as product:
                values = product.get(name, rows if in_block else slice(None))
            return _outer(values, (*key[:-2], slice(None) if in_block else rows, key[-1]))

    return indexing.LazilyIndexedArray(Stack())


def _outer(values: Any, key: tuple[Any, ...]) -> Any:
    """The values at the combinations of one index for each axis."""
    for axis in reversed(range(len(key))):
        values = values[(slice(None),) * axis + (key[axis],)]
    return values


def reduce_to_dataset(capture: Path | str, instrument: Path | str | None = None, **options: Any) -> xr.Dataset:
    """The Mueller or Stokes image of a capture as a Dataset; no file is left behind.

    Parameters
    ----------
    capture : path or str
    instrument : path, str or None
        File to use instead of the model in the capture.
    options
        Of `processing.Reduction`, for instance `weighted=True`.

    Returns
    -------
    xarray.Dataset
        As `open_dataset` gives it for a product, in counts.

    Raises
    ------
    ProcessError
        What `process reduce` would say.

    Examples
    --------
    >>> image = reduce_to_dataset("sphere.h5", weighted=True)
    >>> image.mueller.dims, image.mueller_errors.units
    (('row', 'column', 'y', 'x'), 'count')
    """
    needed("xarray", "xarray")
    step = Reduction(Path(capture), Path(instrument) if instrument else None, **options)
    with tempfile.TemporaryDirectory() as folder:
        return open_dataset(step.make(Path(folder) / "reduced.h5"))


def _attributes(header: CaptureHeader, simulated: bool) -> dict[str, Any]:
    return {
        "title": header.title,
        "wavelength_nm": header.wavelength_nm,
        "omega_deg": np.nan if header.omega_deg is None else header.omega_deg,
        "simulated": int(simulated),
        "header": header.model_dump_json(),
    }


def _of_capture(path: Path) -> xr.Dataset:
    import xarray as xr

    with Capture(path) as capture:
        counts = np.stack([capture.frames(k) for k in range(len(capture.done))])
        column = {name: capture.column(name) for name in ("exposure_s", "host_time_s")}
        coords: dict[str, Any] = {
            "state": ("state", capture.done, {"long_name": "number in the plan"}),
            "channel": ("channel", list(capture.channel_names)),
            "y": ("y", np.arange(counts.shape[2]), {"units": "pixel"}),
            "x": ("x", np.arange(counts.shape[3]), {"units": "pixel"}),
            "role": ("state", list(capture.role)),
            "exposure_s": ("state", column["exposure_s"], {"units": "s"}),
            "time": ("state", column["host_time_s"], {"units": "s", "long_name": "when the frame came, host clock"}),
        }
        for axis, values in capture.angles_deg.items():
            name, units = position_column(axis, axis in capture.header.voltages)
            coords[name] = ("state", values, {"units": units, "long_name": f"{axis}, as read back"})
        attributes = {"units": "count", "long_name": "counts as stored"}
        variables = {"counts": (("state", "channel", "y", "x"), counts, attributes)}
        # What was cut apart here is channels from now on.
        header = capture.header.model_copy(update={"channels": capture.channel_names, "beams": None})
        return xr.Dataset(variables, coords, _attributes(header, capture.simulated))


def _of_product(path: Path) -> xr.Dataset:
    import xarray as xr

    with Product(path) as product:
        variables: dict[str, Any] = {}
        for name in product.names:
            values = product.get(name)
            leading = leading_dimensions(name, values.shape[:-2])
            attributes = {"units": product.units(name), "long_name": product.long_name(name)}
            variables[name] = ((*leading, "y", "x"), values, attributes)
        coords: dict[str, Any] = {
            "y": ("y", np.arange(product.shape[0]), {"units": "pixel"}),
            "x": ("x", np.arange(product.shape[1]), {"units": "pixel"}),
        }
        sizes = {
            dim: size for dims, values, _ in variables.values() for dim, size in zip(dims, values.shape, strict=True)
        }
        coords |= {dim: (dim, np.arange(sizes[dim])) for dim in ("row", "column") if dim in sizes}
        attributes = _attributes(product.header, product.simulated)
        numbers = {
            k: v for k, v in product.facts.items() if isinstance(v, int | float | str) and not isinstance(v, bool)
        }
        return xr.Dataset(variables, coords, attributes | {"kind": product.kind} | numbers)
