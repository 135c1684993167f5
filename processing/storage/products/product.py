"""Product files: what processing makes out of captures. One HDF5 file, NeXus-shaped, with its provenance.

Layout (docs/processing.md): planes first, then (rows, columns); `<name>_errors` holds one standard error for each
value; every step that led here is an NXprocess with its arguments, oldest first.
"""

import json
import os
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from processing.doors import require_place, require_room
from processing.errors import ProcessError
from processing.storage.captures.nexus import (
    PIXEL_AXES,
    add_group,
    add_scales,
    attach,
    declare,
    default_plot,
    describe_light,
)
from processing.storage.captures.schema import CaptureHeader
from processing.storage.integrity.h5_door import (
    OpenH5,
    closed_if_damaged,
    damage_as,
    mark_of,
    open_h5,
    require_dataset,
    require_group,
    text_attribute,
)
from processing.storage.integrity.packing import Packing, create_packed, pack
from processing.storage.integrity.text_heaps import endless_heap
from processing.storage.integrity.unpacking import KeptChunks, read_rows
from processing.storage.products.provenance import Step as Step
from processing.storage.products.provenance import file_identity as file_identity
from processing.storage.products.provenance import jsonable, read_steps, sign, write_steps

PRODUCT_VERSION = 1
#: Environment variable that switches compression of products off where it is 0.
COMPRESS_VARIABLE = "UMOV_COMPRESS"
#: Part of a product that compression has to save to be worth a second writing.
WORTH_SAVING = 0.2

#: A pixel has light where its intensity is this many standard errors above zero; figures and summaries count those.
LIT_ERRORS = 10.0


def is_lit(intensity: NDArray[np.floating], errors: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which pixels have light; where the noise is not known (NaN) any light counts, where it has no bound none does."""
    with np.errstate(invalid="ignore"):
        return np.asarray(intensity > LIT_ERRORS * np.where(np.isnan(errors), 0, errors))


#: Endings of datasets that say how wrong another one may be.
COMPANIONS = ("_errors", "_95", "_systematic", "_directions")
#: Datasets by the name that they had in earlier versions. NeXus keeps the ending `_mask` for the mask of one field.
FORMER_NAMES = {"pixel_mask": "pixel_flags"}


class ProductError(ProcessError):
    """A product file cannot be read or written."""


@dataclass(frozen=True)
class Plane:
    """One dataset of a product: leading shape before (rows, columns), type, unit and a line of description."""

    leading: tuple[int, ...]
    units: str
    long_name: str
    dtype: Any = np.float32


class ProductWriter(OpenH5):
    """Writes a product row block by row block; an interrupted one goes on where it stopped.

    The file is `<path>.partial`, all space allocated at the start, until `seal` renames it. Closed before that it can
    be resumed.

    Parameters
    ----------
    path
        Of the finished product.
    kind
        "mueller", "stokes", ...
    header
        Of the capture that the product comes from.
    shape : (rows, columns).
    planes
        Dataset name to Plane; the first one is the default signal of a viewer.
    steps
        Provenance so far, oldest first.
    overwrite
        Replace a finished product of that name.

    Raises
    ------
    ProcessError
        The product exists and `overwrite` is false, its folder is not there, or the space cannot be had.
    """

    def __init__(
        self,
        path: Path,
        kind: str,
        header: CaptureHeader,
        shape: tuple[int, int],
        *,
        planes: Mapping[str, Plane],
        steps: Sequence[Step],
        overwrite: bool = False,
    ) -> None:
        self.path = path
        require_place(path, overwrite)
        self._partial = path.with_name(path.name + ".partial")
        self._kind, self._header, self._shape, self.planes, self._steps = kind, header, shape, planes, tuple(steps)
        #: Equal in two runs exactly if they would write the same values.
        self._signature = json.dumps(
            [kind, header.model_dump_json(), shape, sorted(planes), [s.made_of for s in steps]]
        )
        self.rows_done = 0
        if not self._reopen():
            self._create()

    def _reopen(self) -> bool:
        if not self._partial.exists() or endless_heap(self._partial) is not None:
            return False
        try:
            h5 = h5py.File(self._partial, "r+")
        except OSError:
            return False
        if h5.attrs.get("signature") != self._signature:
            h5.close()
            return False
        self._h5 = h5
        self.rows_done = int(h5["entry/rows_done"][()])
        return True

    def _create(self) -> None:
        values = sum(
            prod((*plane.leading, *self._shape)) * np.dtype(plane.dtype).itemsize for plane in self.planes.values()
        )
        require_room(self._partial, values, ProductError)
        try:
            self._h5 = h5py.File(self._partial, "w")
            self._lay_out(self._h5, _early)
            self._h5.flush()
            _take_space(self._partial)
        except OSError as error:
            raise ProductError(f"{self._partial} cannot be written ({error}). Free space, or give --out.") from error

    def _lay_out(self, h5: h5py.File, create: Callable[..., h5py.Dataset]) -> None:
        """All groups and datasets, without values; `create` makes a plane (parent, name, shape, type)."""
        header = self._header
        entry = add_group(h5, "entry", "NXentry")
        entry.attrs["default"] = "data"
        h5.attrs.update({"default": "entry", "umov_product": PRODUCT_VERSION, "signature": self._signature})
        entry.attrs.update({"kind": self._kind, "simulated": header.simulated, "header_json": header.model_dump_json()})
        entry.attrs["facts_json"] = "{}"
        entry["title"] = header.title
        entry["rows_done"] = 0
        entry["rows_done"].attrs["units"] = ""
        declare(entry)
        describe_light(entry, header.wavelength_nm, header.sample.name or header.sample.kind)
        self._lay_out_planes(entry, create)
        write_steps(entry, self._steps)
        sign(h5, self._steps)

    def _lay_out_planes(self, entry: h5py.Group, create: Callable[..., h5py.Dataset]) -> None:
        data = add_group(entry, "data", "NXdata")
        shapes = {name: (*plane.leading, *self._shape) for name, plane in self.planes.items()}
        dimensions = {
            name: (*leading_dimensions(name, plane.leading), *PIXEL_AXES) for name, plane in self.planes.items()
        }
        add_scales(data, {d: size for name in shapes for d, size in zip(dimensions[name], shapes[name], strict=True)})
        for name, plane in self.planes.items():
            dataset = create(data, name, shapes[name], plane.dtype)
            dataset.attrs.update({"units": plane.units, "long_name": plane.long_name})
            attach(dataset, data, dimensions[name])
        signal = next(iter(self.planes))
        default_plot(data, signal, dimensions[signal], self._header.title)

    def write(self, rows: slice, **blocks: NDArray[Any]) -> None:
        """Store the blocks (leading..., rows, columns) of some datasets, and remember that the rows are done."""
        data = self._h5["entry/data"]
        for name, block in blocks.items():
            data[name][..., rows, :] = block
        # Values first, then the count of rows that can be trusted: a kill between the two only repeats work.
        self._h5.flush()
        self._h5["entry/rows_done"][...] = rows.stop

    def get(self, name: str, rows: slice = slice(None)) -> NDArray[Any]:
        """What has been written so far: dataset (leading..., rows, columns)."""
        with damage_as(ProductError, f"{self.path} is damaged"):
            return np.asarray(self._h5["entry/data"][name][..., rows, :])

    def array(self, name: str, values: NDArray[Any], units: str, long_name: str) -> None:
        """Store something that is not per pixel (W, a curve) in /entry/reduction; its dimensions bear its name."""
        _add_array(self._h5["entry"], name, values, {"units": units, "long_name": long_name})

    def seal(self, facts: Mapping[str, Any]) -> Path:
        """Add the facts (JSON-able: numbers, warnings), compress where it pays, close, and give the file its name."""
        self._h5["entry"].attrs["facts_json"] = json.dumps(dict(facts), default=jsonable)
        packed = self._packed()
        self._h5.close()
        os.replace(packed or self._partial, self.path)
        if packed is not None:
            self._partial.unlink()
        return self.path

    def discard(self) -> None:
        """Leave nothing of a product that cannot be sealed, and so not be gone on with."""
        self._h5.close()
        self._partial.unlink()

    def _packed(self) -> Path | None:
        """A copy of the file, whose values are all there, with those planes compressed that it makes much smaller.

        None where that is switched off, saves too little, or the disc has no room for both files.
        """
        size = self._partial.stat().st_size
        if os.environ.get(COMPRESS_VARIABLE) == "0" or shutil.disk_usage(self._partial.parent).free < size:
            return None
        source = self._h5["entry"]
        every = {name: Packing.of(plane) for name, plane in source["data"].items() if name in self.planes}
        packings = {name: packing for name, packing in every.items() if packing.is_worth_it}
        saved = sum(source["data"][name].nbytes * (1 - 1 / packing.ratio) for name, packing in packings.items())
        if saved < WORTH_SAVING * size:
            return None

        def create(data: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any) -> h5py.Dataset:
            return (create_packed if name in packings else _early)(data, name, shape, dtype)

        path = self._partial.with_name(self._partial.name + ".packed")
        with h5py.File(path, "w") as h5:
            self._lay_out(h5, create)
            entry = h5["entry"]
            for name in self.planes:
                if name in packings:
                    pack(source["data"][name], entry["data"][name], packings[name])
                else:
                    entry["data"][name][...] = source["data"][name][...]
            for name, array in source.get("reduction", {}).items():
                if not array.is_scale:
                    _add_array(entry, name, array[()], {key: array.attrs[key] for key in ("units", "long_name")})
            entry["rows_done"][...] = source["rows_done"][()]
            entry.attrs["facts_json"] = source.attrs["facts_json"]
        return path


class Product(OpenH5):
    """One product file, open for reading.

    Attributes
    ----------
    kind : str; "mueller", "stokes", ...
    simulated : bool
    header : CaptureHeader of the capture it comes from
    steps
        Provenance, oldest first
    facts : dict of numbers and warnings of the last step
    shape : (rows, columns)

    Examples
    --------
    >>> with Product(Reduction("sphere.h5").make()) as product:
    ...     product.kind, product.shape, product.steps[-1].name, product.units("mueller")
    ('mueller', (24, 32), 'reduce', 'count')
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise ProductError(f"{self.path}: no such file. `process reduce` prints the name of what it writes.")
        self._h5 = open_h5(self.path, ProductError)
        with closed_if_damaged(self._h5, ProductError, f"{self.path} is damaged, or not a whole product"):
            self._read()

    def _read(self) -> None:
        if "umov_product" not in self._h5.attrs:
            raise ProductError(
                f"{self.path} is not a product of `process`. A capture goes through `process reduce` first."
            )
        version = int(self._h5.attrs["umov_product"])
        if version > PRODUCT_VERSION:
            raise ProductError(
                f"{self.path} has product version {version}; this program reads up to {PRODUCT_VERSION}."
            )
        entry = require_group(self._h5, "entry")
        self.kind = text_attribute(entry, "kind")
        self.simulated = bool(entry.attrs["simulated"])
        self.header = CaptureHeader.model_validate_json(text_attribute(entry, "header_json"))
        self.facts: dict[str, Any] = dict(json.loads(text_attribute(entry, "facts_json")))
        self.steps = read_steps(entry)
        data = require_group(entry, "data")
        stored = [name for name in data if not _is_beside(name, data[name])]
        self._stored = {FORMER_NAMES.get(name, name): name for name in stored}
        self.names: tuple[str, ...] = tuple(self._stored)
        self._kept: defaultdict[str, KeptChunks] = defaultdict(KeptChunks)
        rows, columns = data[text_attribute(data, "signal")].shape[-2:]
        self.shape: tuple[int, int] = (int(rows), int(columns))
        for name in stored:
            leading = (None,) * (data[name].ndim - 2)
            require_dataset(data, name, (*leading, *self.shape), "uif")

    def require(self, *kinds: str) -> None:
        """Raise ProductError unless the product is of one of the kinds."""
        if self.kind not in kinds:
            raise ProductError(f"{self.path} holds {_a(self.kind)} image; this needs: {', '.join(kinds)}.")

    def _dataset(self, name: str) -> h5py.Dataset:
        if name not in self.names:
            raise ProductError(f"{self.path} has no {name!r}; it has: {', '.join(self.names)}.")
        return self._h5["entry/data"][self._stored[name]]

    def get(self, name: str, rows: slice = slice(None)) -> NDArray[Any]:
        """Dataset (leading..., rows, columns)."""
        dataset = self._dataset(name)
        with damage_as(ProductError, f"{self.path} is damaged"):
            return read_rows(dataset, rows, cache=self._kept[name])

    def units(self, name: str) -> str:
        """Unit of a dataset."""
        return self._attribute_text(name, "units")

    def long_name(self, name: str) -> str:
        """What a dataset is, in one line."""
        return self._attribute_text(name, "long_name")

    def _attribute_text(self, name: str, attribute: str) -> str:
        dataset = self._dataset(name)
        with damage_as(ProductError, f"{self.path} is damaged"):
            return text_attribute(dataset, attribute)

    def array(self, name: str) -> NDArray[Any]:
        """An array of /entry/reduction that is not per pixel, such as the measurement matrix."""
        if not self.has_array(name):
            raise ProductError(f"{self.path} has no array {name!r} beside its images.")
        with damage_as(ProductError, f"{self.path} is damaged"):
            return np.asarray(self._h5[f"entry/reduction/{name}"][...])

    def has_array(self, name: str) -> bool:
        """Whether /entry/reduction holds an array."""
        return f"entry/reduction/{name}" in self._h5

    def row_blocks(self, pixels: int = 1 << 17) -> Iterable[slice]:
        """Row slices of about `pixels` pixels."""
        step = max(1, pixels // max(self.shape[1], 1))
        return [slice(k, min(k + step, self.shape[0])) for k in range(0, self.shape[0], step)]


def _add_array(entry: h5py.Group, name: str, values: NDArray[Any], words: Mapping[str, str]) -> None:
    """Write an array of /entry/reduction; without scales of its own xarray takes equal lengths for one dimension."""
    group = entry.require_group("reduction")
    group.attrs["NX_class"] = "NXcollection"
    sizes = {f"{name}_axis_{k}": size for k, size in enumerate(np.shape(values))}
    for earlier in (name, *sizes):
        if earlier in group:
            del group[earlier]
    add_scales(group, sizes)
    group.create_dataset(name, data=values).attrs.update(words)
    attach(group[name], group, [*sizes])


def _a(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


def _is_beside(name: str, dataset: h5py.Dataset) -> bool:
    """Whether a dataset of the plot is a coordinate or its title, and no plane."""
    return name == "title" or dataset.is_scale


def leading_dimensions(name: str, leading: tuple[int, ...]) -> tuple[str, ...]:
    """Names of the dimensions of a plane before (y, x): row and column of a matrix, else NAME_0, NAME_1, ..."""
    if leading == (4, 4):
        return ("row", "column")
    return tuple(f"{name.removesuffix('_errors')}_{k}" for k in range(len(leading)))


def is_product(path: Path) -> bool:
    """Whether a file is a product of `process` (and not a capture, or anything else)."""
    return mark_of(path, "umov_product") is not None


def _take_space(path: Path) -> None:
    """Have the disc hold the file as long as it is: one that is only said to be long can still find it full."""
    if not hasattr(os, "posix_fallocate"):
        # macOS and Windows: writing finds out.
        return
    # For reading too: where the file system cannot do it, the C library looks at every block.
    with path.open("rb+") as file:
        os.posix_fallocate(file.fileno(), 0, os.fstat(file.fileno()).st_size)


def _early(parent: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any) -> h5py.Dataset:
    # Contiguous and allocated now: a full disc fails at the start, and a killed run leaves a readable file.
    create = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    create.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    create.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    space = h5py.h5s.create_simple(shape)
    kind = h5py.h5t.py_create(np.dtype(dtype), logical=True)
    return h5py.Dataset(h5py.h5d.create(parent.id, name.encode(), kind, space, dcpl=create))
