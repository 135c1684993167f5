"""Tables to and from the renderer Mitsuba's `.pbsdf`, the format in which the lab of Jarecki and Kupinski publishes.

A `.pbsdf` holds M[phi_d, theta_d, theta_h, wavelength, 4, 4], theta_h quadratic, as a BRDF in 1/sr:
the cosine of the angle of incidence is divided out. Each matrix refers to the axis s of the facet for both beams
(docs/conventions.md, "Tables and renderers"): `process table` turns every pixel by its own angles. Directions below
the surface are NaN there.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from processing.arrays import Array
from processing.geometry.frames import ScatteringGeometry
from processing.geometry.rusinkiewicz import Angles, directions
from processing.reflectance.base import ReflectanceModel
from processing.reflectance.table_axes import SHAPE, TableAxes
from processing.reflectance.tables import ScatteringTable, TableError
from processing.storage.formats.tensor_file import create_tensor_file, read_tensor_file

MUELLER = tuple(f"m{i}{j}" for i in range(4) for j in range(4))
#: The renderer's reader takes exactly this many wavelengths.
RENDERER_WAVELENGTHS = 5


def export(
    tables: Sequence[ScatteringTable],
    path: Path | str,
    white_m00: float = 1.0,
    empty: Literal["nearest", "nan"] = "nearest",
    *,
    pad_wavelengths: bool = True,
    progress: Callable[[int, int], None] | None = None,
    uncertainty: bool = False,
) -> float:
    """Write a `.pbsdf` of Mueller tables; returns the fraction of visible bins that no sample filled.

    Parameters
    ----------
    tables : one for each wavelength, of m00..m33 in "renderer" frames and layout.
    white_m00 : M00 that a perfect white surface has at normal incidence in these units; BRDF = M/(white pi cos).
        Without a radiometric calibration only the polarization is right, not the absolute reflectance. A table in 1/sr
        is not scaled; its relative uncertainty is the field `scale_u`, NaN without.
    empty : what goes into visible bins without samples: the nearest filled bin's value, or NaN (black).
    pad_wavelengths : repeat the outer wavelengths up to the 5 that the renderer reads.
    progress : called with wavelengths written and in all.
    uncertainty : add the field `u`, in the layout of M: standard uncertainty by noise and instrument together, NaN in
        gaps. Mitsuba ignores it.

    Raises
    ------
    TableError
        A table has another layout, other quantities or other frames, is empty, or holds no uncertainty to be added.
    """
    ordered = sorted(tables, key=lambda t: t.wavelength_nm)
    for table in ordered:
        _check(table, white_m00, uncertainty)
    wavelengths = [round(t.wavelength_nm) for t in ordered]
    slots = list(range(len(ordered)))
    while pad_wavelengths and len(slots) < RENDERER_WAVELENGTHS:
        # Outwards, by turns, one nanometre steps: interpolation between equal values changes nothing.
        if len(slots) % 2:
            slots, wavelengths = [*slots, slots[-1]], [*wavelengths, wavelengths[-1] + 50]
        else:
            slots, wavelengths = [slots[0], *slots], [wavelengths[0] - 50, *wavelengths]
    axes = TableAxes("renderer")
    shape = (SHAPE[2], SHAPE[1], SHAPE[0], len(slots), 4, 4)
    fields = create_tensor_file(
        Path(path),
        {
            "theta_h": ((1, SHAPE[0]), np.float32),
            "theta_d": ((1, SHAPE[1]), np.float32),
            "phi_d": ((1, SHAPE[2]), np.float32),
            "wvls": ((len(slots),), np.uint16),
            "scale_u": ((len(slots),), np.float32),
            "M": (shape, np.float32),
            **({"u": (shape, np.float32)} if uncertainty else {}),
        },
    )
    fields["theta_h"][0] = np.deg2rad(axes.theta_h_deg)
    fields["theta_d"][0] = np.deg2rad(axes.theta_d_deg)
    fields["phi_d"][0] = np.deg2rad(axes.phi_d_deg)
    fields["wvls"][...] = wavelengths
    fields["scale_u"][...] = [np.nan if (u := ordered[source].scale_u) is None else u for source in slots]
    missing, written = 0.0, 0
    for k, table in enumerate(ordered):
        blocks = {}
        blocks["M"], gaps = fill_bins(table, table.mean, white_m00, empty)
        if uncertainty:
            total = np.sqrt(sum(np.square(part) for part in table.uncertainties.values()))
            blocks["u"], _ = fill_bins(table, total, white_m00, "nan")
        missing = max(missing, gaps)
        for slot, source in enumerate(slots):
            if source == k:
                for name, block in blocks.items():
                    fields[name][..., slot, :, :] = block
                written += 1
                if progress:
                    progress(written, len(slots))
    for field in fields.values():
        field.flush()  # type: ignore[attr-defined]
    return missing


def load(path: Path | str, white_m00: float = 1.0, only_nm: float | None = None) -> dict[int, ScatteringTable]:
    """Tables by wavelength (nm) of a `.pbsdf`, one sample a bin; NaN bins stay empty.

    Raises TableError: it is no pBRDF, or has other axes than 91 x 91 x 361 in the renderer's layout.
    """
    fields = read_tensor_file(Path(path))
    lacking = {"theta_h", "theta_d", "phi_d", "wvls", "M"} - set(fields)
    if lacking:
        raise TableError(f"{path} lacks {', '.join(sorted(lacking))}: it is no pBRDF.")
    axes = TableAxes("renderer")
    stored = (fields["theta_h"], fields["theta_d"], fields["phi_d"])
    for values, expected, name in zip(
        stored, (axes.theta_h_deg, axes.theta_d_deg, axes.phi_d_deg), ("theta_h", "theta_d", "phi_d"), strict=True
    ):
        if values.size != expected.size or not np.allclose(np.rad2deg(values.reshape(-1)), expected, atol=0.02):
            raise TableError(f"{path}: its {name} axis is not the 91 x 91 x 361 layout that the renderer's files have")
    wavelengths, shape = fields["wvls"].reshape(-1), fields["M"].shape
    if shape != (*SHAPE[::-1], wavelengths.size, 4, 4) or fields["M"].dtype.kind != "f":
        raise TableError(f"{path}: M is {fields['M'].dtype} {shape}, not {(*SHAPE[::-1], wavelengths.size, 4, 4)}")
    if fields["wvls"].dtype.kind not in "uif" or np.unique(np.rint(wavelengths)).size != wavelengths.size:
        raise TableError(f"{path}: its wavelengths are not all different")
    if not np.all((wavelengths > 0) & (wavelengths < 1e6)):
        raise TableError(f"{path}: its wavelengths are no wavelengths in nm")
    angles, cos_i, _ = bin_centres()
    tables = {}
    for k, wavelength in enumerate(wavelengths):
        if only_nm is not None and abs(only_nm - wavelength) > 0.5:
            continue
        m = np.moveaxis(fields["M"][..., k, :, :].reshape(*SHAPE[::-1], 16), -1, 0).transpose(0, 3, 2, 1)
        values = m[..., :-1] * (white_m00 * np.pi * np.maximum(cos_i, 0.0))[..., :-1]
        is_lit = (cos_i > 0)[..., :-1] & np.isfinite(values).all(axis=0)
        table = ScatteringTable(MUELLER, float(wavelength), "renderer", frames="renderer")
        table.add(Angles(*(a[..., :-1][is_lit] for a in angles)), values[:, is_lit])
        tables[int(wavelength)] = table
    return tables


def model_table(
    model: ReflectanceModel, wavelength_nm: float, progress: Callable[[int, int], None] | None = None
) -> ScatteringTable:
    """Table in 1/sr, in renderer frames and layout, of a model that has a BRDF.

    Raises TableError: the model describes the dominant process alone, as all but `rough_plastic` do.
    """
    if not hasattr(model, "brdf"):
        raise TableError("this kind of material has no brightness, only a dominant process. Give a rough_plastic.")
    axes = TableAxes("renderer")
    table = ScatteringTable(MUELLER, wavelength_nm, "renderer", frames="renderer", scale_u=np.nan)
    theta_h, *differences = (np.deg2rad(a) for a in (axes.theta_h_deg, axes.theta_d_deg, axes.phi_d_deg[:-1]))
    parts = np.split(theta_h, np.arange(13, len(theta_h), 13))
    for k, part in enumerate(parts):
        angles = Angles(*(a.reshape(-1) for a in np.meshgrid(part, *differences, indexing="ij")))
        # y is the axis s of both beams, also where source and camera coincide.
        points = ScatteringGeometry(*directions(*angles), up=np.array([1.0, 0.0, 0.0]))
        values = model.brdf(points, wavelength_nm).reshape(-1, 16).T
        is_lit = values[0] > 0
        table.add(Angles(*(a[is_lit] for a in angles)), values[:, is_lit])
        if progress:
            progress(k + 1, len(parts))
    return table


def _check(table: ScatteringTable, white_m00: float, uncertainty: bool) -> None:
    expected = (MUELLER, "renderer", "renderer")
    if (table.quantities, table.axes.layout, table.frames) != expected:
        raise TableError(
            f"a .pbsdf needs a table of m00..m33 in renderer frames and layout; this one holds "
            f"{table.quantities[0]}.. in {table.frames or 'no'} frames, layout {table.axes.layout!r}"
        )
    if table.bins.size == 0:
        raise TableError(f"the table at {table.wavelength_nm:g} nm is empty: nothing to export")
    if table.units and white_m00 != 1.0:
        raise TableError("a table of a BRDF in 1/sr has its scale already. Leave --white-m00 away.")
    if uncertainty and not table.has_noise:
        raise TableError(f"the table at {table.wavelength_nm:g} nm does not know its noise. Leave --uncertainty away.")


def bin_centres() -> tuple[Angles, Array, Array]:
    """Bin centres (theta_h, theta_d, phi_d) and the cosines at them."""
    axes = TableAxes("renderer")
    grid = np.meshgrid(
        *(np.deg2rad(a) for a in (axes.theta_h_deg, axes.theta_d_deg, axes.phi_d_deg)), indexing="ij", sparse=True
    )
    th, td, ph = np.broadcast_arrays(*grid)
    along = np.cos(grid[0]) * np.cos(grid[1])
    across = np.sin(grid[0]) * np.sin(grid[1]) * np.cos(grid[2])
    return Angles(th, td, ph), along - across, along + across


def fill_bins(table: ScatteringTable, values: Array, white_m00: float, empty: str) -> tuple[NDArray[np.float32], float]:
    """Values (16, bins) of a table in the layout of the file, and the fraction of visible bins without samples."""
    _, cos_i, cos_o = bin_centres()
    visible = (cos_i > 0) & (cos_o > 0)
    row = np.full(SHAPE, -1, dtype=np.int32)
    row.reshape(-1)[table.bins] = np.arange(table.bins.size, dtype=np.int32)
    row[..., -1] = row[..., 0]  # -180 and +180 degrees are one direction
    filled = row >= 0
    gaps = float(1 - (filled & visible).sum() / visible.sum())
    if empty == "nearest":
        # Once round phi_d on either side, so that the distance is cyclic.
        around = np.concatenate([row[..., :-1]] * 2 + [row], axis=2)[..., 180 : 180 + 361 + 360]
        index = distance_transform_edt(around < 0, return_distances=False, return_indices=True)
        row = around[tuple(index)][..., 180 : 180 + 361]
    scale = np.zeros(SHAPE, dtype=np.float32)
    per = np.ones(SHAPE) if table.units else white_m00 * np.pi * cos_i
    np.divide(1.0, per, out=scale, where=visible, casting="unsafe")
    scale[~visible | (row < 0)] = np.nan
    mean = values.astype(np.float32)
    array = np.empty((*SHAPE[::-1], 16), dtype=np.float32)
    for q in range(16):
        array[..., q] = (mean[q][row] * scale).transpose(2, 1, 0)
    return array.reshape(*SHAPE[::-1], 4, 4), gaps
