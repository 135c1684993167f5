"""Writes a product file row block by row block, compressed where that pays."""

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from processing.doors import require_place, require_room
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
from processing.storage.integrity.h5_door import OpenH5, damage_as
from processing.storage.integrity.packing import Packing, create_packed, pack
from processing.storage.integrity.text_heaps import endless_heap
from processing.storage.products.product import PRODUCT_VERSION, Plane, ProductError, leading_dimensions
from processing.storage.products.provenance import Step, jsonable, sign, write_steps

#: Environment variable that switches compression of products off where it is 0.
COMPRESS_VARIABLE = "UMOV_COMPRESS"
#: Part of a product that compression has to save to be worth a second writing.
WORTH_SAVING = 0.2


class ProductWriter(OpenH5):
    """Writes a product row block by row block; an interrupted one goes on where it stopped.

    The file is `<path>.partial`, all space allocated at the start, until `seal` renames it. Closed before that it can
    be resumed.

    Parameters
    ----------
    path : of the finished product.
    kind : "mueller", "stokes", ...
    header : of the capture that the product comes from.
    shape : (rows, columns).
    planes : dataset name to Plane; the first one is the default signal of a viewer.
    steps : provenance so far, oldest first.
    overwrite : replace a finished product of that name.

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
