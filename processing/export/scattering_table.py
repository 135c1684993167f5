"""A scattering table as text: a row for each bin that has samples."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from processing.doors import require_place
from processing.errors import ProcessError
from processing.export.csv_file import write_csv
from processing.reflectance.tables import AXES, ScatteringTable


def table_to_csv(source: Path, out: Path, quantities: Sequence[str] = (), overwrite: bool = False) -> list[Path]:
    """Write a table of `process table` as CSV; returns the file.

    The centre of each bin in degrees, the number of its samples, then of each quantity the mean, its standard
    uncertainties as far as they are known, and the variance of the samples; that of a single one is nan.

    Parameters
    ----------
    quantities : some of those in the table; all by default.

    Raises
    ------
    ProcessError
        The file exists, or the table has no quantity of a name.
    """
    path = out.with_name(f"{out.name}.csv")
    require_place(path, overwrite)
    table = ScatteringTable.load(source)
    unknown = [name for name in quantities if name not in table.quantities]
    if unknown:
        raise ProcessError(f"{source} has no {unknown[0]!r}; it has: {', '.join(table.quantities)}")
    # In the order of the axes, not in that of the first samples.
    order = np.argsort(table.bins)
    centres = table.axes.angles(table.bins[order])
    columns = {name: np.rad2deg(angle).round(9) for name, angle in zip(AXES, centres, strict=True)}
    columns["samples"] = table.count[order]
    mean, variance, uncertainties = table.mean[:, order], table.variance[:, order], table.uncertainties
    for k, name in enumerate(table.quantities):
        if not quantities or name in quantities:
            columns[name] = mean[k]
            columns |= {f"{name}_{part}": values[k, order] for part, values in uncertainties.items()}
            columns[f"{name}_sample_variance"] = variance[k]
    facts = {
        "wavelength_nm": table.wavelength_nm,
        "simulated": table.simulated,
        "layout": table.axes.layout,
        "frames": table.frames or "none: scalars",
        "scale": "BRDF in 1/sr" if table.units else "none",
        "uncertain_in_the_instrument": "; ".join(table.inputs) or "nothing stated",
    }
    write_csv(path, facts, dict.fromkeys(AXES, "degree"), columns)
    return [path]
