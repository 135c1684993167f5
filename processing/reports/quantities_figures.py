"""Figure of a quantities product: eigenvalues, depolarization, DoLP and AoLP, retardance, polarizer pairs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from processing.polarization.quantities import PAPER_PAIRS
from processing.polarization.scalar_files import scalar_quantities
from processing.reports.colours import SIGNED, colours_of, upper_end
from processing.reports.figure_style import CYCLIC, WORST_ORIENTATION_DEG, grid_figure, percentile, thin
from processing.storage.products.product import COMPANIONS, Product

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FRACTION = {"vmin": 0, "vmax": 1}


def quantities_figure(product: Product, title: str) -> Figure:
    """Five rows of four maps each, or what a partial polarimeter has; NaN and pixels without light in grey."""
    if "coherency_eigenvalues" not in product.names:
        return _partial_figure(product, title)
    lit = thin(product.get("lit")) > 0

    def get(name: str) -> NDArray[Any]:
        return np.where(lit, thin(product.get(name)), np.nan)

    def orientation(name: str) -> NDArray[Any]:
        angle, error = get(name), get(f"{name}_errors")
        return np.where(error > WORST_ORIENTATION_DEG, np.nan, angle)

    def label(text: str, name: str) -> str:
        error = get(f"{name}_errors")
        middle = np.nanmedian(error[0] if error.ndim == 3 else error) if np.isfinite(error).any() else np.nan
        return text if np.isnan(middle) else f"{text}   ($\\pm$ {middle:.2g})"

    xi, deviation = get("coherency_eigenvalues"), get("eigenvalue_deviation")
    spread = max(percentile(np.abs(deviation), 99), 1e-6)
    signed = {"cmap": SIGNED, "vmin": -spread, "vmax": spread}
    panels: list[tuple[str, NDArray[Any], dict[str, Any]]] = [
        (label(r"$\xi_0$", "coherency_eigenvalues"), xi[0], {"vmin": 0.25}),
        *((rf"$\xi_{k}$", xi[k], {"vmin": 0, "vmax": 1 / 3}) for k in (1, 2, 3)),
        *((rf"$\xi_{k} - \bar\xi$", deviation[k - 1], signed) for k in (1, 2, 3)),
        (label("light the TD model misses", "td_missed"), get("td_missed"), {"cmap": "magma", "vmin": 0}),
        (label("depolarization index", "depolarization_index"), get("depolarization_index"), {"vmin": 0}),
        (label("entropy", "entropy"), get("entropy"), {"vmax": 1}),
        (label("depolarization power (Lu-Chipman)", "depolarization_power"), get("depolarization_power"), {"vmax": 1}),
        (label("retardance (Lu-Chipman) / deg", "retardance_deg"), get("retardance_deg"), {"vmin": 0, "vmax": 180}),
        (
            label("DoLP, unpolarized light", "polarizance_linear"),
            get("polarizance_linear"),
            {"vmin": 0, "vmax": upper_end(get("polarizance_linear"))},
        ),
        ("AoLP, unpolarized light, PSA frame / deg", orientation("polarizance_orientation_deg"), CYCLIC),
        (
            label("$|D|$ of the dominant process", "dominant_diattenuation_linear"),
            get("dominant_diattenuation_linear"),
            _FRACTION,
        ),
        (
            r"$\psi$ of the dominant process, PSG frame / deg",
            orientation("dominant_diattenuation_orientation_deg"),
            CYCLIC,
        ),
    ]
    for name in scalar_quantities():
        if name in product.names:
            panels.append((label(name.replace("_", " "), name), get(name), {"vmin": 0}))
    for name in product.names:
        if name in PAPER_PAIRS or ("_to_" in name and not name.endswith(COMPANIONS)):
            text = name.replace("_", " ") + " over $m_{00}$"
            panels.append((label(text, name), get(name), {"cmap": "gray", "vmin": 0}))
    return grid_figure(panels, f"{title}\n($\\pm$: median standard error of a pixel)", product.simulated)


def _partial_figure(product: Product, title: str) -> Figure:
    lit = thin(product.get("lit")) > 0
    panels: list[tuple[str, NDArray[Any], dict[str, Any]]] = []
    for name in product.names:
        if name == "lit" or name.endswith(COMPANIONS):
            continue
        shown = np.where(lit, thin(product.get(name)), np.nan)
        colours = colours_of(name, product.units(name))
        if colours == CYCLIC["cmap"]:
            shown = np.where(thin(product.get(f"{name}_errors")) > WORST_ORIENTATION_DEG, np.nan, shown)
            panels.append((name.replace("_", " "), shown, CYCLIC))
        else:
            most = max(percentile(np.abs(shown), 99), 1e-6)
            limits = {"cmap": SIGNED, "vmin": -most, "vmax": most} if colours == SIGNED else {"vmin": 0}
            panels.append((name.replace("_", " "), shown, limits))
    return grid_figure(panels, title, product.simulated)
