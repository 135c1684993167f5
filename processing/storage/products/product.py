"""Product files: what processing makes out of captures. One HDF5 file, NeXus-shaped, with its provenance.

Layout (docs/processing.md): planes first, then (rows, columns); `<name>_errors` holds one standard error for each
value; every step that led here is an NXprocess with its arguments, oldest first.
"""

import json
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from processing.errors import ProcessError
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
from processing.storage.integrity.unpacking import KeptChunks, read_rows
from processing.storage.products.provenance import Step as Step
from processing.storage.products.provenance import file_identity as file_identity
from processing.storage.products.provenance import read_steps

PRODUCT_VERSION = 1

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
        stored = [name for name in data if name != "title" and not data[name].is_scale]
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


def _a(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


def leading_dimensions(name: str, leading: tuple[int, ...]) -> tuple[str, ...]:
    """Names of the dimensions of a plane before (y, x): row and column of a matrix, else NAME_0, NAME_1, ..."""
    if leading == (4, 4):
        return ("row", "column")
    return tuple(f"{name.removesuffix('_errors')}_{k}" for k in range(len(leading)))


def is_product(path: Path) -> bool:
    """Whether a file is a product of `process` (and not a capture, or anything else)."""
    return mark_of(path, "umov_product") is not None
