"""Figures of a campaign and of a Stokes design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.calibration.illumination_design import Prediction
from processing.campaign.run import PAPER, CampaignResult
from processing.geometry.viewing import ViewingGeometry
from processing.reflectance.tables import ScatteringTable
from processing.reports.colours import SIGNED
from processing.reports.figure_style import entitle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: As in Jarecki and Kupinski: blue squares at 451 nm, red triangles at 662 nm.
STYLES = {451: ("tab:blue", "s"), 662: ("tab:red", "^")}
_OTHERS = ("tab:green", "tab:purple", "tab:orange", "tab:brown")


#: Quantities of a figure of curves where none is chosen, as far as the captures have them.
CURVES = (
    *("m00", "s0", "depolarization_index", "dop", "polarizance_linear", "dolp", "diattenuation_linear"),
    *("retardance_deg", "docp", "polarizance_orientation_deg", "aolp_deg", "ellipticity_deg"),
)


def curves_figure(rows: Sequence[Mapping[str, Any]], quantities: Sequence[str], title: str, simulated: bool) -> Figure:
    """Quantities against the arm angle, with bars of 95 %: a curve for each sample, wavelength and mode.

    `rows` are those of `processing.campaign.curves.CurvePoint`. Without several angles the captures are in a row.
    """
    from matplotlib.figure import Figure

    columns = min(3, len(quantities))
    high = -(-len(quantities) // columns)
    figure = Figure(figsize=(1 + 4.4 * columns, 0.8 + 3.4 * high), layout="constrained")
    panels = figure.subplots(high, columns, squeeze=False).flat
    captures = list(dict.fromkeys(row["capture"] for row in rows))
    against_omega = len({row["omega_deg"] for row in rows if row["omega_deg"] == row["omega_deg"]}) > 1
    for panel, name in zip(panels, quantities, strict=False):
        curves: dict[str, list[Mapping[str, Any]]] = {}
        for row in rows:
            if row["quantity"] == name:
                label = f"{row['sample']}, {row['wavelength_nm']:g} nm{', ' + row['mode'] if row['mode'] else ''}"
                curves.setdefault(label, []).append(row)
        for label, points in curves.items():
            x = [row["omega_deg"] if against_omega else captures.index(row["capture"]) + 1 for row in points]
            order = np.argsort(x)
            y, low, top = (np.array([row[part] for row in points])[order] for part in ("value", "low", "high"))
            bars = np.maximum([y - low, top - y], 0)
            panel.errorbar(np.array(x)[order], y, bars, marker="o", markersize=3, linewidth=1, capsize=2, label=label)
        unit = next((row["unit"] for row in rows if row["quantity"] == name), "")
        panel.set_title(name.replace("_", " "), fontsize=10)
        panel.set_ylabel(unit)
        panel.set_xlabel("$\\Omega$ / degrees" if against_omega else "capture, in the order of the table")
        panel.legend(fontsize=7)
    for panel in list(panels):
        panel.set_axis_off()
    entitle(figure, f"{title}: means of the region, bars: 95 %", simulated)
    return figure


def campaign_figure(result: CampaignResult, title: str, with_paper: bool = False) -> Figure:
    """RMSD of psi, |D| and xi0 against arm angle; dotted: noise, dashed: averages of Jarecki and Kupinski."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4.2), layout="constrained")
    panels = figure.subplots(1, 3)
    quantities = (
        ("psi_deg", "$\\epsilon(\\psi)$ / degrees", "psi_noise_deg"),
        ("magnitude_percent", "$\\epsilon(|D|)$ / %", "magnitude_noise_percent"),
        ("xi0_percent", "$\\epsilon(\\xi_0)$ / %", "xi0_noise_percent"),
    )
    for number, nm in enumerate(sorted({r.wavelength_nm for r in result.rows})):
        colour, marker = STYLES.get(round(nm), (_OTHERS[number % 4], "o"))
        rows = [r for r in result.rows if r.wavelength_nm == nm]
        omega = [r.omega_deg for r in rows]
        for panel, (name, label, noise) in zip(panels, quantities, strict=True):
            panel.plot(omega, [getattr(r, name) for r in rows], color=colour, marker=marker, label=f"{nm:g} nm")
            panel.plot(omega, [getattr(r, noise) for r in rows], color=colour, linestyle=":")
            if with_paper and round(nm) in PAPER:
                panel.axhline(getattr(PAPER[round(nm)], name), color=colour, linestyle="--", linewidth=0.8)
            panel.set_xlabel("$\\Omega$ / degrees")
            panel.set_ylabel(label)
    for panel in panels:
        panel.set_ylim(bottom=0)
        panel.plot([], [], color="0.3", linestyle=":", label="noise alone")
        if with_paper:
            panel.plot([], [], color="0.3", linestyle="--", linewidth=0.8, label="paper, average")
        panel.legend(fontsize=8)
    figure.suptitle(f"SIMULATED   {title}" if result.simulated else title, fontsize=11)
    return figure


def tables_figure(
    reference: ScatteringTable,
    other: ScatteringTable,
    view: ViewingGeometry,
    omega_deg: float,
    *,
    shape: tuple[int, int],
) -> Figure:
    """xi0 of two tables on a virtual object, and their difference."""
    from processing.reports.figure_style import grid_figure

    image = view.at(omega_deg, *shape)
    a, b = (image.fill(t.lookup(image.points.angles)[0]) for t in (reference, other))
    finite = np.concatenate([v[np.isfinite(v)] for v in (a, b)])
    top = float(np.percentile(finite, 99.5)) if finite.size else 1.0
    spread = np.abs(b - a)[np.isfinite(b - a)]
    limit = max(float(np.percentile(spread, 99)), 1e-6) if spread.size else 1.0
    scale = {"vmin": 0.25, "vmax": top}
    return grid_figure(
        [
            ("$\\xi_0$, reference", a, scale),
            ("$\\xi_0$, other", b, scale),
            ("other - reference", b - a, {"cmap": SIGNED, "vmin": -limit, "vmax": limit}),
        ],
        f"virtual object, {reference.wavelength_nm:g} nm, $\\Omega$ = {omega_deg:g} degrees",
        reference.simulated,
        columns=3,
    )


def stokes_design_figure(predictions: Mapping[float, Sequence[Prediction]]) -> Figure:
    """Predicted standard error of xi0 against arm angle: horizontal, vertical and the best, a panel a wavelength."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.5 + 4.5 * len(predictions), 4.2), layout="constrained")
    panels = figure.subplots(1, len(predictions), squeeze=False, sharey=True)[0]
    for panel, (nm, ranked) in zip(panels, predictions.items(), strict=True):
        shown = {p.name: p for p in ranked if p.name in ("horizontal", "vertical")} | {ranked[0].name: ranked[0]}
        for name, p in shown.items():
            (line,) = panel.semilogy(p.omega_deg, p.p90, marker="o", label=f"{name}, 90 % of pixels")
            panel.semilogy(p.omega_deg, p.median, color=line.get_color(), linestyle="--", label=f"{name}, median")
        panel.set_title(f"{nm:g} nm", fontsize=10)
        panel.set_xlabel("$\\Omega$ / degrees")
        panel.set_xticks(np.arange(20, 91, 10))
        panel.legend(fontsize=8)
    panels[0].set_ylabel("predicted standard error of $\\xi_0$")
    return figure
