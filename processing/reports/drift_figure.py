"""Figure of the checks of an instrument over time."""

from datetime import datetime
from pathlib import Path

import numpy as np

from processing.campaign.drift import read_checks
from processing.reports.figure_style import entitle
from processing.whole_file import whole_file


def draw_drift(table: Path, figure_path: Path, title: str, tolerance: float, *, simulated: bool) -> None:
    """Draw the light and the elements of M/m00 of all checks of a table, with the band of the tolerance."""
    from matplotlib.figure import Figure

    rows = read_checks(table)
    names = [name.removesuffix("_error") for name in rows[-1] if name.endswith("_error")]
    times = [datetime.fromisoformat(row["start_time"]) for row in rows]
    figure = Figure(figsize=(9, 6.5), layout="constrained")
    light, elements = figure.subplots(2, 1, sharex=True, height_ratios=[1, 2])
    light.plot(times, [float(row["light_percent"]) for row in rows], marker="o", color="black")
    light.set_ylabel("light / %")
    elements.axhspan(-tolerance, tolerance, color="0.9", label="tolerance")
    values = {name: np.array([float(row[name]) for row in rows]) for name in names}
    largest = sorted(names, key=lambda name: -np.nan_to_num(np.abs(values[name])).max())[:5]
    for name in names:
        errors = [float(row[f"{name}_error"]) for row in rows]
        if name in largest:
            elements.errorbar(times, values[name], errors, marker="o", markersize=3, capsize=2, label=name)
        else:
            elements.plot(times, values[name], color="0.7", linewidth=0.8)
    elements.set_ylabel("change of M/m00")
    elements.legend(fontsize=8, ncols=6)
    figure.autofmt_xdate()
    entitle(figure, f"change since {title}; the five elements that changed most are named", simulated)
    with whole_file(figure_path) as new:
        figure.savefig(new, dpi=150, format="png")
