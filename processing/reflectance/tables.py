"""Tables over scattering geometry: mean, variance and count a bin, from any number of images.

Sparse in memory and on disc: a capture of a sphere fills few of the three million bins.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from processing.arrays import Array
from processing.computing.threads import for_ranges
from processing.errors import ProcessError
from processing.geometry.rusinkiewicz import Angles
from processing.instrument.uncertainty import align_inputs
from processing.reflectance.table_axes import SHAPE, Layout, TableAxes
from processing.reflectance.table_kernels import add_sums, claim_rows
from processing.storage.captures.nexus import add_group, add_scales, attach, declare, default_plot, describe_light
from processing.storage.integrity.h5_door import damage_as, mark_of, open_h5, require_dataset, require_group
from processing.storage.integrity.packing import LEVEL, Packing
from processing.storage.products.provenance import Step, read_steps, sign, write_steps

#: 1 had everything in the root, without NeXus groups; up to 2 the errors were quantities with names of their own.
SCHEMA_VERSION = 3

#: Centres of the bins along each axis, degrees.
AXES = ("theta_h_deg", "theta_d_deg", "phi_d_deg")
#: Columns beside the mean of each quantity.
UNCERTAINTIES = {
    "u_noise": "standard uncertainty of the mean by noise",
    "u_systematic": "standard uncertainty of the mean by the instrument's; it does not average",
}
_SUMS = ("sum", "sum_of_squares")


class TableError(ProcessError):
    """A table cannot be made, read or merged as asked."""


class BinGroups(NamedTuple):
    """Samples that were added together, by bin.

    Attributes
    ----------
    group : (N,), number of the group of each sample; negative: left out.
    size : (G,), samples of each group.
    """

    group: NDArray[np.int32]
    size: NDArray[np.int64]

    def mean(self, values: NDArray[np.floating]) -> Array:
        """Means (..., G) over each group of values (..., N)."""
        flat = np.ascontiguousarray(values.reshape(-1, values.shape[-1]))
        total, square = (np.zeros((len(flat), self.size.size)) for _ in range(2))
        add_sums(self.group, flat, total, square, np.zeros_like(self.size))
        return np.asarray((total / self.size).reshape(*values.shape[:-1], -1))


class ScatteringTable:
    """Mean, variance and count of quantities over (theta_h, theta_d, phi_d) at one wavelength.

    Parameters
    ----------
    quantities : names, e.g. ("xi0",) or ("m00", ..., "m33").
    wavelength_nm : of the light.
    layout : "degree" or "renderer", see `TableAxes`.
    simulated : whether the values come from a simulation; a table never mixes the two.
    frames : axes to which Mueller elements refer: "instrument", "renderer" or "" for scalars.
    has_noise : whether samples come with the variance of their noise.
    inputs : uncertain inputs of the instrument; samples come with what one standard uncertainty of each does to them.
    scale_u : standard uncertainty of the absolute scale over itself; None: values are in counts, not a BRDF in 1/sr.
    """

    def __init__(
        self,
        quantities: tuple[str, ...],
        wavelength_nm: float,
        layout: Layout = "degree",
        simulated: bool = False,
        *,
        frames: str = "",
        has_noise: bool = False,
        inputs: tuple[str, ...] = (),
        scale_u: float | None = None,
    ) -> None:
        self.quantities = quantities
        self.wavelength_nm = float(wavelength_nm)
        self.axes = TableAxes(layout)
        self.simulated = simulated
        self.frames = frames
        self.has_noise = has_noise
        self.inputs = inputs
        self.scale_u = scale_u
        self._row = np.full(SHAPE[0] * SHAPE[1] * SHAPE[2], -1, dtype=np.int32)
        self.bins = np.empty(0, dtype=np.int32)
        self.count = np.empty(0, dtype=np.int64)
        # Bins of the pixels of the last image, filled again by the next: the first touch of new memory is slow.
        self._scratch: NDArray[np.int32] | None = None
        # Sums of all planes, sums of squares of the quantities: double, so that a variance keeps its digits.
        self._sum = np.empty((self.planes, 0))
        self._square = np.empty((len(quantities), 0))

    def add(
        self,
        angles: Angles,
        values: ArrayLike,
        simulated: bool | None = None,
        uncertainty: Callable[[BinGroups], Iterator[Array]] | None = None,
    ) -> None:
        """Add samples: angles (...) in radians and values (planes, ...); a sample with any NaN is left out.

        The planes are the quantities, with `has_noise` the variance of each, then for each of `inputs` all quantities.
        All but the quantities may come from `uncertainty` instead: means over the samples of a bin, for all quantities
        (quantities, groups) at a time. Raises TableError: `simulated` differs from the table's, or shapes do not fit.
        """
        if simulated is not None and simulated != self.simulated:
            raise TableError(
                f"the table holds {_kind(self.simulated)} values and was given {_kind(simulated)} ones; "
                "the two are never mixed. Make one table for each."
            )
        v = np.asarray(values)
        shape = np.shape(angles.theta_h)
        quantities = len(self.quantities)
        expected = (self.planes if uncertainty is None else quantities, *shape)
        if v.shape != expected:
            raise TableError(f"expected values of shape {expected}, got {v.shape}")
        v = np.ascontiguousarray(v.reshape(len(v), -1))
        if v.dtype not in (np.float32, np.float64):
            v = v.astype(np.float64)
        rows = self._scratch = self.axes.bins(angles, self._scratch).reshape(-1)
        sums = np.empty(len(v))
        for_ranges(len(v), lambda a, b: v[a:b].sum(axis=1, out=sums[a:b]), align=1, smallest=1)
        # Far quicker than to look at each pixel.
        if not np.all(np.isfinite(sums)):
            rows[~np.isfinite(v).all(axis=0)] = -1
        self._claim(rows)
        add_sums(rows, v[:quantities], self._sum, self._square, self.count)
        samples, further = np.flatnonzero(rows >= 0), self._sum[quantities:]
        if uncertainty is None:
            for plane, more in zip(v[quantities:], further, strict=True):
                more += np.bincount(rows[samples], plane[samples], minlength=self.count.size)
            return
        filled, of_sample, size = np.unique(rows[samples], return_inverse=True, return_counts=True)
        group = np.full(rows.size, -1, dtype=np.int32)
        group[samples] = of_sample
        for start, means in zip(range(0, len(further), quantities), uncertainty(BinGroups(group, size)), strict=True):
            further[start : start + quantities, filled] += means * size

    @property
    def units(self) -> str:
        """Of the values: 1/sr of a BRDF, or empty."""
        return "" if self.scale_u is None else "1/sr"

    @property
    def planes(self) -> int:
        """Number of planes of a sample."""
        return len(self.quantities) * (1 + self.has_noise + len(self.inputs))

    @property
    def mean(self) -> Array:
        """(quantities, bins)."""
        return np.asarray(self._sum[: len(self.quantities)] / self.count)

    @property
    def variance(self) -> Array:
        """(quantities, bins), of the samples in each bin; NaN with one sample."""
        spread = np.maximum(self._square - self._sum[: len(self.quantities)] ** 2 / self.count, 0.0)
        return np.where(self.count > 1, spread / np.maximum(self.count - 1, 1), np.nan)

    @property
    def directions(self) -> Array:
        """(inputs, quantities, bins), what one standard uncertainty of each input does to the mean."""
        moved = self._sum[len(self.quantities) * (1 + self.has_noise) :] / self.count
        return np.asarray(moved.reshape(len(self.inputs), len(self.quantities), self.count.size))

    @property
    def uncertainties(self) -> dict[str, Array]:
        """Standard uncertainties (quantities, bins) of the mean, as far as known: `u_noise`, `u_systematic`."""
        n, planes = len(self.quantities), {}
        if self.has_noise:
            planes["u_noise"] = np.sqrt(self._sum[n : 2 * n]) / self.count
        if self.inputs:
            planes["u_systematic"] = np.sqrt(np.square(self.directions).sum(axis=0))
        return planes

    def lookup(self, angles: Angles, of: Array | None = None) -> Array:
        """Mean (quantities, ...) at directions (...) in radians, of the nearest bin; NaN without a sample.

        `of` (..., bins) is looked up instead of the mean.
        """
        of = self.mean if of is None else of
        bins = self.axes.bins(angles)
        rows = np.where(bins >= 0, self._row[bins], -1)
        if self.bins.size == 0:
            return np.full((*of.shape[:-1], *rows.shape), np.nan)
        is_filled = (rows >= 0) & (self.count[rows] >= 1)
        return np.where(is_filled, of[..., rows], np.nan)

    def counts(self, angles: Angles) -> NDArray[np.int64]:
        """Number of samples (...) of the bin of each direction."""
        bins = self.axes.bins(angles)
        rows = np.where(bins >= 0, self._row[bins], -1)
        return np.where(rows >= 0, self.count[rows], 0) if self.bins.size else np.zeros(rows.shape, dtype=np.int64)

    def merge(self, other: "ScatteringTable") -> None:
        """Add all samples of another table of the same quantities, wavelength and layout.

        What the inputs of another instrument do is kept apart from what those of this one do. Raises TableError: the
        tables do not belong together, or one of them knows no uncertainty of its instrument.
        """
        this, that = (
            (t.quantities, t.wavelength_nm, t.axes, t.simulated, t.frames, t.has_noise, bool(t.inputs), t.scale_u)
            for t in (self, other)
        )
        if this != that:
            raise TableError(f"tables differ and cannot be merged: {this} and {that}")
        quantities, start = len(self.quantities), len(self.quantities) * (1 + self.has_noise)
        parts = [t._sum[start:].reshape(-1, quantities, t.count.size) for t in (self, other)]
        self.inputs, (base, more) = align_inputs([self.inputs, other.inputs], parts)
        self._sum = np.concatenate([self._sum[:start], base.reshape(-1, self.count.size)])
        rows = other.bins.copy()
        self._claim(rows)
        self.count[rows] += other.count
        self._sum[:, rows] += np.concatenate([other._sum[:start], more.reshape(-1, other.count.size)])
        self._square[:, rows] += other._square

    def _claim(self, bins: NDArray[np.int32]) -> None:
        # Replaces each bin by its row, and gives a row to the new ones.
        new_bins = np.empty(bins.size, dtype=np.int32)
        new = claim_rows(bins, self._row, self.bins.size, new_bins)
        if new:
            grown = np.zeros((self.planes, new))
            self.bins = np.concatenate([self.bins, new_bins[:new]])
            self.count = np.concatenate([self.count, np.zeros(new, dtype=np.int64)])
            self._sum = np.hstack([self._sum, grown])
            self._square = np.hstack([self._square, grown[: len(self.quantities)]])

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
            if self.scale_u is not None:
                h5.attrs["scale_u"] = self.scale_u
            h5.attrs["frames"] = self.frames
            h5.attrs.update({"quantities": list(self.quantities), "inputs": list(self.inputs), "default": "entry"})
            entry = add_group(h5, "entry", "NXentry")
            entry.attrs.update({"default": "data", "simulated": self.simulated})
            title = f"{', '.join(self.quantities)} over scattering angles, {self.wavelength_nm:g} nm"
            entry["title"] = title
            declare(entry)
            describe_light(entry, self.wavelength_nm, "those of the captures in the table")
            self._lay_out_bins(add_group(entry, "data", "NXdata"), title)
            sums = add_group(entry, "sums", "NXcollection")
            add_scales(sums, {"quantity": len(self.quantities), "bin": self.bins.size})
            for name, values in zip(_SUMS, (self._sum[: len(self.quantities)], self._square), strict=True):
                text = f"{name} over the samples of a bin"
                _put(sums, name, values, sums, dimensions=("quantity", "bin"), units="", long_name=text)
            for name in AXES:
                sums[name] = getattr(self.axes, name)
                sums[name].make_scale(name)
                sums[name].attrs.update({"units": "degree", "long_name": "centres of all bins along the axis"})
            write_steps(entry, steps)
            sign(h5, steps)
        partial.replace(path)

    def _lay_out_bins(self, data: h5py.Group, title: str) -> None:
        """What people look at: of each bin that has samples their mean and variance, their number, and its angles."""
        add_scales(data, {"quantity": len(self.quantities)})
        text = "number of the bin, counted over theta_h, theta_d, phi_d"
        _put(data, "bin", self.bins, data, dimensions=(), units="", long_name=text)
        data["bin"].make_scale("bin")
        data["quantity_name"] = np.array([name.encode() for name in self.quantities], dtype="S")
        attach(data["quantity_name"], data, ["quantity"])
        _put(data, "count", self.count, data, dimensions=["bin"], units="", long_name="samples in the bin")
        for name, angle in zip(AXES, self.axes.angles(self.bins), strict=True):
            degrees, text = np.rad2deg(angle).round(9), "centre of the bin"
            _put(data, name, degrees, data, dimensions=["bin"], units="degree", long_name=text)
        planes = {
            "mean": (self.mean, self.units, "mean of the samples in the bin"),
            "sample_variance": (self.variance, "", "variance of the samples in the bin"),
        }
        for name, values in self.uncertainties.items():
            planes[name] = values.astype(np.float32), self.units, UNCERTAINTIES[name]
        for name, (plane, units, text) in planes.items():
            _put(data, name, plane, data, dimensions=("quantity", "bin"), units=units, long_name=text)
        if self.inputs:
            add_scales(data, {"input": len(self.inputs)})
            data["input_name"] = np.array([name.encode() for name in self.inputs], dtype="S")
            attach(data["input_name"], data, ["input"])
            text = "what one standard uncertainty of each uncertain input of the instrument does to the mean"
            dimensions = ("input", "quantity", "bin")
            values = self.directions.astype(np.float32)
            _put(data, "directions", values, data, dimensions=dimensions, units="", long_name=text)
        default_plot(data, "mean", ("quantity", "bin"), title)
        data["mean"].attrs["coordinates"] = " ".join([*AXES, "count", "quantity_name"])
        for name in (*AXES, "count"):
            data.attrs[f"{name}_indices"] = 1
        data.attrs["quantity_name_indices"] = 0

    @classmethod
    def load(cls, path: Path | str) -> "ScatteringTable":
        """Read a table. Raises TableError when the file is none, or its axes are not those of its layout."""
        failing = damage_as(TableError, f"{path} cannot be read as a scattering table")
        with failing, open_h5(Path(path), TableError) as h5:
            if "umov_table" not in h5.attrs:
                raise TableError(f"{path} is no scattering table. `process table` makes one.")
            a = h5.attrs
            version = int(a["umov_table"])
            if version > SCHEMA_VERSION:
                raise TableError(f"{path} has table version {version}; this program reads up to {SCHEMA_VERSION}.")
            data, sums = (h5 if version == 1 else require_group(h5, f"entry/{name}") for name in ("data", "sums"))
            names = [str(q) for q in a["quantities"]]
            quantities, has_noise, inputs = names, "u_noise" in data, [str(i) for i in a.get("inputs", ())]
            if version < 3 and names[1:2] == ["xi0_variance"]:
                quantities, has_noise, inputs = names[:1], True, [n.split("_", 3)[3] for n in names[2:]]
            table = cls(
                tuple(quantities),
                float(a["wavelength_nm"]),
                a["layout"],
                bool(a["simulated"]),
                frames=str(a["frames"]),
                has_noise=has_noise,
                inputs=tuple(inputs),
                scale_u=float(a["scale_u"]) if "scale_u" in a else None,
            )
            if not np.allclose(sums["theta_h_deg"][...], table.axes.theta_h_deg):
                raise TableError(f"{path}: its theta_h axis is not that of layout {a['layout']!r}")
            bins = require_dataset(data, "bin", (None,), "i")[...]
            n, q = bins.size, len(table.quantities)
            if n and not (bins.min() >= 0 and bins.max() < table._row.size and np.unique(bins).size == n):
                raise ValueError("bins outside the axes, or given twice")
            table.bins, table.count = bins, require_dataset(data, "count", (n,), "i")[...]
            total, square = (require_dataset(sums, name, (len(names), n), "f")[...] for name in _SUMS)
            if version >= 3:
                parts = [total]
                if has_noise:
                    parts.append(np.square(require_dataset(data, "u_noise", (q, n), "f")[...] * table.count))
                if inputs:
                    moved = require_dataset(data, "directions", (len(inputs), q, n), "f")[...]
                    parts.append((moved * table.count).reshape(-1, n))
                total = np.concatenate(parts)
            table._sum, table._square = total, square[:q]
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
    *,
    dimensions: Sequence[str],
    units: str,
    long_name: str,
) -> None:
    """Store an array, compressed where that pays, its dimensions named by scales."""
    options: dict[str, Any] = {}
    if values.size and Packing.of(np.atleast_2d(values)).is_worth_it:
        options = {"compression": "gzip", "compression_opts": LEVEL, "shuffle": True}
    dataset = group.create_dataset(name, data=values, **options)
    dataset.attrs.update({"units": units, "long_name": long_name})
    attach(dataset, scales, dimensions)


def _kind(simulated: bool) -> str:
    return "simulated" if simulated else "measured"
