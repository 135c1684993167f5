"""Tables over scattering geometry: mean, variance and count a bin, from any number of images.

Sparse in memory and on disc: a capture of a sphere fills few of the three million bins.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from processing.arrays import Array
from processing.computing.compiling import njit
from processing.computing.threads import for_ranges
from processing.errors import ProcessError
from processing.geometry.rusinkiewicz import Angles
from processing.reflectance.table_axes import SHAPE, Layout, TableAxes
from processing.storage.captures.nexus import add_group, add_scales, attach, declare, default_plot, describe_light
from processing.storage.integrity.h5_door import damage_as, mark_of, open_h5, require_dataset
from processing.storage.products.provenance import Step, read_steps, sign, write_steps

#: 1 had everything in the root, without NeXus groups.
SCHEMA_VERSION = 2


#: Centres of the bins along each axis, degrees.
AXES = ("theta_h_deg", "theta_d_deg", "phi_d_deg")


class TableError(ProcessError):
    """A table cannot be made, read or merged as asked."""


class ScatteringTable:
    """Mean, variance and count of quantities over (theta_h, theta_d, phi_d) at one wavelength.

    Parameters
    ----------
    quantities : names, e.g. ("xi0",) or ("m00", ..., "m33").
    wavelength_nm : of the light.
    layout : "degree" or "renderer", see `TableAxes`.
    simulated : whether the values come from a simulation; a table never mixes the two.
    frames : axes to which Mueller elements refer: "instrument", "renderer" or "" for scalars.
    """

    def __init__(
        self,
        quantities: tuple[str, ...],
        wavelength_nm: float,
        layout: Layout = "degree",
        simulated: bool = False,
        frames: str = "",
    ) -> None:
        self.quantities = quantities
        self.wavelength_nm = float(wavelength_nm)
        self.axes = TableAxes(layout)
        self.simulated = simulated
        self.frames = frames
        self._row = np.full(SHAPE[0] * SHAPE[1] * SHAPE[2], -1, dtype=np.int32)
        self.bins = np.empty(0, dtype=np.int32)
        self.count = np.empty(0, dtype=np.int64)
        # Bins of the pixels of the last image, filled again by the next: the first touch of new memory is slow.
        self._scratch: NDArray[np.int32] | None = None
        # Sums and sums of squares, (quantities, bins): double, so that a variance keeps its digits.
        self._sum = np.empty((len(quantities), 0))
        self._square = np.empty((len(quantities), 0))

    def add(self, angles: Angles, values: ArrayLike, simulated: bool | None = None) -> None:
        """Add samples: angles (...) in radians and values (quantities, ...); a sample with any NaN is left out.

        Raises
        ------
        TableError
            `simulated` differs from the table's, or shapes do not fit.
        """
        if simulated is not None and simulated != self.simulated:
            raise TableError(
                f"the table holds {_kind(self.simulated)} values and was given {_kind(simulated)} ones; "
                "the two are never mixed. Make one table for each."
            )
        v = np.asarray(values)
        shape = np.shape(angles.theta_h)
        if v.shape != (len(self.quantities), *shape):
            raise TableError(f"expected values of shape {(len(self.quantities), *shape)}, got {v.shape}")
        v = np.ascontiguousarray(v.reshape(len(v), -1))
        if v.dtype not in (np.float32, np.float64):
            v = v.astype(np.float64)
        rows = self._scratch = self.axes.bins(angles, self._scratch).reshape(-1)
        sums = np.empty(len(v))
        for_ranges(len(v), lambda start, stop: _plane_sums(v, sums, start, stop), align=1, smallest=1)
        if not np.all(np.isfinite(sums)):
            _drop_unknown(rows, v)
        self._claim(rows)
        groups = (len(v) + 3) // 4
        total, square, count = self._sum, self._square, self.count
        for_ranges(
            groups, lambda start, stop: _accumulate(rows, v, total, square, count, start, stop), align=1, smallest=1
        )

    @property
    def mean(self) -> Array:
        """(quantities, bins)."""
        return np.asarray(self._sum / self.count)

    @property
    def variance(self) -> Array:
        """(quantities, bins), of the samples in each bin; NaN with one sample."""
        spread = np.maximum(self._square - self._sum**2 / self.count, 0.0)
        return np.where(self.count > 1, spread / np.maximum(self.count - 1, 1), np.nan)

    def lookup(self, angles: Angles, min_count: int = 1) -> Array:
        """Mean (quantities, ...) at directions (...) in radians, of the nearest bin; NaN with too few samples."""
        bins = self.axes.bins(angles)
        rows = np.where(bins >= 0, self._row[bins], -1)
        if self.bins.size == 0:
            return np.full((len(self.quantities), *rows.shape), np.nan)
        known = (rows >= 0) & (self.count[rows] >= min_count)
        return np.where(known, self.mean[:, rows], np.nan)

    def counts(self, angles: Angles) -> NDArray[np.int64]:
        """Number of samples (...) of the bin of each direction."""
        bins = self.axes.bins(angles)
        rows = np.where(bins >= 0, self._row[bins], -1)
        return np.where(rows >= 0, self.count[rows], 0) if self.bins.size else np.zeros(rows.shape, dtype=np.int64)

    def merge(self, other: ScatteringTable) -> None:
        """Add all samples of another table of the same quantities, wavelength and layout. Raises TableError."""
        mine = (self.quantities, self.wavelength_nm, self.axes, self.simulated, self.frames)
        theirs = (other.quantities, other.wavelength_nm, other.axes, other.simulated, other.frames)
        if mine != theirs:
            raise TableError(f"tables differ and cannot be merged: {mine} and {theirs}")
        rows = other.bins.copy()
        self._claim(rows)
        self.count[rows] += other.count
        self._sum[:, rows] += other._sum
        self._square[:, rows] += other._square

    def _claim(self, bins: NDArray[np.int32]) -> None:
        # Replaces each bin by its row, and gives a row to the new ones.
        found = np.empty(bins.size, dtype=np.int32)
        new = _claim_rows(bins, self._row, self.bins.size, found)
        if new:
            grown = np.zeros((len(self.quantities), new))
            self.bins = np.concatenate([self.bins, found[:new]])
            self.count = np.concatenate([self.count, np.zeros(new, dtype=np.int64)])
            self._sum, self._square = np.hstack([self._sum, grown]), np.hstack([self._square, grown])

    def save(self, path: Path | str, steps: Sequence[Step] = ()) -> None:
        """Write the filled bins and the axes to HDF5, and the steps that led to them, oldest first.

        Sums are kept in double, so a table may go on growing.
        """
        path = Path(path)
        partial = path.with_name(path.name + ".partial")
        with h5py.File(partial, "w") as h5:
            h5.attrs["umov_table"] = SCHEMA_VERSION
            h5.attrs["wavelength_nm"] = self.wavelength_nm
            h5.attrs["layout"] = self.axes.layout
            h5.attrs["simulated"] = self.simulated
            h5.attrs["frames"] = self.frames
            h5.attrs.update({"quantities": list(self.quantities), "default": "entry"})
            entry = add_group(h5, "entry", "NXentry")
            entry.attrs.update({"default": "data", "simulated": self.simulated})
            title = f"{', '.join(self.quantities)} over scattering angles, {self.wavelength_nm:g} nm"
            entry["title"] = title
            declare(entry)
            describe_light(entry, self.wavelength_nm, "those of the captures in the table")
            self._lay_out_bins(add_group(entry, "data", "NXdata"), title)
            sums = add_group(entry, "sums", "NXcollection")
            for name, values in (("sum", self._sum), ("sum_of_squares", self._square)):
                _put(sums, name, values, entry["data"], ("quantity", "bin"), "", f"{name} over the samples of a bin")
            for name in AXES:
                sums[name] = getattr(self.axes, name)
                sums[name].attrs.update({"units": "degree", "long_name": "centres of all bins along the axis"})
            write_steps(entry, steps)
            sign(h5, steps)
        partial.replace(path)

    def _lay_out_bins(self, data: h5py.Group, title: str) -> None:
        """What people look at: of each bin that has samples their mean and variance, their number, and its angles."""
        add_scales(data, {"quantity": len(self.quantities)})
        _put(data, "bin", self.bins, data, (), "", "number of the bin, counted over theta_h, theta_d, phi_d")
        data["bin"].make_scale("bin")
        data["quantity_name"] = [name.encode() for name in self.quantities]
        attach(data["quantity_name"], data, ["quantity"])
        _put(data, "count", self.count, data, ["bin"], "", "samples in the bin")
        for name, angle in zip(AXES, self.axes.angles(self.bins), strict=True):
            _put(data, name, np.rad2deg(angle).round(9), data, ["bin"], "degree", "centre of the bin")
        _put(data, "mean", self.mean, data, ("quantity", "bin"), "", "mean of the samples in the bin")
        _put(
            data, "sample_variance", self.variance, data, ("quantity", "bin"), "", "variance of the samples in the bin"
        )
        default_plot(data, "mean", ("quantity", "bin"), title)
        data["mean"].attrs["coordinates"] = " ".join([*AXES, "count", "quantity_name"])
        for name in (*AXES, "count"):
            data.attrs[f"{name}_indices"] = 1
        data.attrs["quantity_name_indices"] = 0

    @classmethod
    def load(cls, path: Path | str) -> ScatteringTable:
        """Read a table. Raises TableError when the file is none, or its axes are not those of its layout."""
        failing = damage_as(TableError, f"{path} cannot be read as a scattering table")
        with failing, open_h5(Path(path), TableError) as h5:
            if "umov_table" not in h5.attrs:
                raise TableError(f"{path} is no scattering table. `process table` makes one.")
            a = h5.attrs
            if int(a["umov_table"]) > SCHEMA_VERSION:
                raise TableError(
                    f"{path} has table version {a['umov_table']}; this program reads up to {SCHEMA_VERSION}."
                )
            first = int(a["umov_table"]) == 1
            data, sums = (h5, h5) if first else (h5["entry/data"], h5["entry/sums"])
            table = cls(
                tuple(str(q) for q in a["quantities"]),
                float(a["wavelength_nm"]),
                a["layout"],
                bool(a["simulated"]),
                str(a["frames"]),
            )
            if not np.allclose(sums["theta_h_deg"][...], table.axes.theta_h_deg):
                raise TableError(f"{path}: its theta_h axis is not that of layout {a['layout']!r}")
            bins = require_dataset(data, "bin", (None,), "i")[...]
            n, q = bins.size, len(table.quantities)
            if n and not (bins.min() >= 0 and bins.max() < table._row.size and np.unique(bins).size == n):
                raise ValueError("bins outside the axes, or given twice")
            table.bins, table.count = bins, require_dataset(data, "count", (n,), "i")[...]
            table._sum = require_dataset(sums, "sum", (q, n), "f")[...]
            table._square = require_dataset(sums, "sum_of_squares", (q, n), "f")[...]
        table._row[table.bins] = np.arange(table.bins.size, dtype=np.int32)
        return table


def is_table(path: Path | str) -> bool:
    """Whether a file is a table that `ScatteringTable.save` wrote."""
    return mark_of(Path(path), "umov_table") is not None


def table_steps(path: Path | str) -> tuple[Step, ...]:
    """Steps that led to a table, oldest first."""
    failing = damage_as(TableError, f"{path} cannot be read as a scattering table")
    with failing, open_h5(Path(path), TableError) as h5:
        return read_steps(h5.get("entry", h5))


def _put(
    group: h5py.Group,
    name: str,
    values: NDArray[Any],
    scales: h5py.Group,
    dimensions: Sequence[str],
    units: str,
    long_name: str,
) -> None:
    """Store an array, compressed, its dimensions named by scales."""
    options: dict[str, Any] = {"compression": "gzip", "shuffle": True} if values.size else {}
    dataset = group.create_dataset(name, data=values, **options)
    dataset.attrs.update({"units": units, "long_name": long_name})
    attach(dataset, scales, dimensions)


def _kind(simulated: bool) -> str:
    return "simulated" if simulated else "measured"


@njit(nogil=True, cache=True, fastmath={"reassoc", "contract"})
def _plane_sums(values, out, start, stop):  # type: ignore[no-untyped-def]
    # Finite when every value is: far quicker than to look at each pixel.
    for c in range(start, stop):
        total = values.dtype.type(0)
        for n in range(values.shape[1]):
            total += values[c, n]
        out[c] = total


@njit(nogil=True, cache=True)
def _drop_unknown(rows, values):  # type: ignore[no-untyped-def]
    for n in range(rows.size):
        total = 0.0
        for c in range(values.shape[0]):
            total += values[c, n]
        if not np.isfinite(total):
            rows[n] = -1


@njit(cache=True)
def _claim_rows(bins, row_of_bin, used, found):  # type: ignore[no-untyped-def]
    # Replaces each bin by its row in the sparse arrays; new bins get the next rows.
    new = 0
    for n in range(bins.size):
        b = bins[n]
        if b < 0:
            continue
        r = row_of_bin[b]
        if r < 0:
            r = used + new
            row_of_bin[b] = r
            found[new] = b
            new += 1
        bins[n] = r
    return new


@njit(nogil=True, cache=True, fastmath={"contract"})
def _accumulate(rows, values, total, square, count, start, stop):  # type: ignore[no-untyped-def]
    # Four quantities a thread: no two threads write to one place, and the eight sums do not wait for each
    # other. A run of pixels in one bin, the rule in an image, stays in registers.
    quantities = values.shape[0]
    for group in range(start, stop):
        first = 4 * group
        c1, c2, c3 = min(first + 1, quantities - 1), min(first + 2, quantities - 1), min(first + 3, quantities - 1)
        v0, v1, v2, v3 = values[first], values[c1], values[c2], values[c3]
        last, k = -1, 0
        s0 = s1 = s2 = s3 = q0 = q1 = q2 = q3 = 0.0
        for n in range(rows.size + 1):
            r = rows[n] if n < rows.size else -1
            if r != last:
                if last >= 0:
                    total[first, last] += s0
                    square[first, last] += q0
                    if c1 == first + 1:
                        total[c1, last] += s1
                        square[c1, last] += q1
                    if c2 == first + 2:
                        total[c2, last] += s2
                        square[c2, last] += q2
                    if c3 == first + 3:
                        total[c3, last] += s3
                        square[c3, last] += q3
                    if group == 0:
                        count[last] += k
                last, k = r, 0
                s0 = s1 = s2 = s3 = q0 = q1 = q2 = q3 = 0.0
            if r >= 0:
                a, b, c, d = np.float64(v0[n]), np.float64(v1[n]), np.float64(v2[n]), np.float64(v3[n])
                s0, s1, s2, s3 = s0 + a, s1 + b, s2 + c, s3 + d
                q0, q1, q2, q3 = q0 + a * a, q1 + b * b, q2 + c * c, q3 + d * d
                k += 1
