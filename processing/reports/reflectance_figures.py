"""Figures of a campaign and of a Stokes design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from processing.calibration.illumination_design import Prediction
from processing.campaign.run import PAPER, CampaignResult
from processing.geometry.viewing import ViewingGeometry
from processing.reflectance.tables import ScatteringTable
from processing.reports.colours import SIGNED

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: As in Jarecki and Kupinski: blue squares at 451 nm, red triangles at 662 nm.
STYLES = {451: ("tab:blue", "s"), 662: ("tab:red", "^")}
_OTHERS = ("tab:green", "tab:purple", "tab:orange", "tab:brown")


def campaign_figure(result: CampaignResult, title: str) -> Figure:
    """RMSD of psi, |D| and xi0 against arm angle; dashed: averages of Jarecki and Kupinski, dotted: noise."""
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
            if round(nm) in PAPER:
                panel.axhline(getattr(PAPER[round(nm)], name), color=colour, linestyle="--", linewidth=0.8)
            panel.set_xlabel("$\\Omega$ / degrees")
            panel.set_ylabel(label)
    for panel in panels:
        panel.set_ylim(bottom=0)
        panel.plot([], [], color="0.3", linestyle=":", label="noise alone")
        panel.plot([], [], color="0.3", linestyle="--", linewidth=0.8, label="paper, average")
        panel.legend(fontsize=8)
    figure.suptitle(f"SIMULATED   {title}" if result.simulated else title, fontsize=11)
    return figure


def tables_figure(
    reference: ScatteringTable, other: ScatteringTable, view: ViewingGeometry, omega_deg: float, shape: tuple[int, int]
) -> Figure:
    """xi0 of two tables on a virtual object, and their difference."""
    from processing.reports.figure_style import grid_figure

    image = view.at(omega_deg, *shape)
    a, b = (image.fill(t.lookup(image.points.angles)[0]) for t in (reference, other))
    finite = np.concatenate([v[np.isfinite(v)] for v in (a, b)])
    top = float(np.percentile(finite, 99.5)) if finite.size else 1.0
    spread = np.abs(b - a)[np.isfinite(b - a)]
    limit = max(float(np.percentile(spread, 99)), 1e-6) if spread.size else 1.0
    both = {"vmin": 0.25, "vmax": top}
    return grid_figure(
        [
            ("$\\xi_0$, reference", a, both),
            ("$\\xi_0$, other", b, both),
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
