"""Report section of a table over scattering geometry."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.reflectance.table_axes import SHAPE
from processing.reflectance.tables import ScatteringTable, table_steps
from processing.reports.figure_style import map_figure, png
from processing.reports.template import Figure, ReportSection
from processing.storage.products.provenance import steps_text


def table_section(path: Path) -> ReportSection:
    """Numbers of a table, its first quantity over theta_h and theta_d, averaged over phi_d, and its uncertainties."""
    table = ScatteringTable.load(path)
    name = table.quantities[0]
    scale = [] if (u := table.scale_u) is None else [("scale", f"BRDF in 1/sr, relative standard uncertainty {u:.2g}")]
    summary = [
        ("kind", f"table over theta_h, theta_d, phi_d, {'simulated' if table.simulated else 'measured'}"),
        ("quantities", ", ".join(table.quantities)),
        ("wavelength", f"{table.wavelength_nm:g} nm"),
        ("layout", table.axes.layout),
        ("bins filled", f"{table.bins.size} of {SHAPE[0] * SHAPE[1] * (SHAPE[2] - 1)}"),
        ("samples", str(int(table.count.sum()))),
        *scale,
        ("uncertain in the instrument", "; ".join(table.inputs) or "nothing stated"),
        *(
            (f"{part} of a bin's mean {name}, median", f"{np.nanmedian(values[0]):.3g}")
            for part, values in table.uncertainties.items()
            if table.bins.size
        ),
    ]
    notes = [("provenance, oldest first", steps_text(table_steps(path)))] if table_steps(path) else []
    if not table.bins.size:
        return ReportSection(path.name, summary, notes=notes)
    mean, count = _over_phi(table, table.mean[0])
    spread = {"cmap": "magma", "origin": "lower"}
    parts = [(part, _over_phi(table, values[0])[0], spread) for part, values in table.uncertainties.items()]
    drawn = map_figure(
        [
            (f"{name}, mean over $\\phi_d$", mean, {"cmap": "viridis", "origin": "lower"}),
            *parts,
            ("samples (log10)", count, spread),
        ],
        f"{path.name}: rows $\\theta_h$, columns $\\theta_d$, bins",
        table.simulated,
    )
    figure = Figure(png(drawn), f"{name} over theta_h (up) and theta_d (right)")
    return ReportSection(path.name, summary, [figure], notes=notes)


def _over_phi(table: ScatteringTable, values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    # Samples count alike, so bins with many of them count more.
    plane = table.bins // SHAPE[2]
    size = SHAPE[0] * SHAPE[1]
    count = np.bincount(plane, weights=table.count, minlength=size)
    total = np.bincount(plane, weights=values * table.count, minlength=size)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean, samples = total / count, np.where(count > 0, np.log10(count), np.nan)
    return mean.reshape(SHAPE[:2]), samples.reshape(SHAPE[:2])
