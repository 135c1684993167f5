"""Figure of a quantities product: eigenvalues, depolarization, DoLP and AoLP, retardance, polarizer pairs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from processing.product import Product

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Orientation is drawn in grey where its standard error is above this: it is not known there.
WORST_ORIENTATION_DEG = 20.0

_FRACTION = {"cmap": "viridis", "vmin": 0, "vmax": 1}
_CYCLIC = {"cmap": "twilight", "vmin": 0, "vmax": 180}


def quantities_figure(product: Product, title: str) -> Figure:
    """Five rows of four maps each; angles on a cyclic colour map, NaN and pixels without light in grey."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    from processing.figures import SIMULATED, thin

    lit = thin(product.get("lit")) > 0

    def get(name: str) -> NDArray[Any]:
        return np.where(lit, thin(product.get(name)), np.nan)

    def orientation(name: str) -> NDArray[Any]:
        angle, error = get(name), get(f"{name}_errors")
        return np.where(error > WORST_ORIENTATION_DEG, np.nan, angle)

    xi, deviation = get("coherency_eigenvalues"), get("eigenvalue_deviation")
    spread = max(_percentile(np.abs(deviation), 99), 1e-6)
    signed = {"cmap": "RdBu_r", "vmin": -spread, "vmax": spread}
    small = {"cmap": "viridis", "vmin": 0, "vmax": 1 / 3}
    missed, dolp = get("td_missed"), get("polarizance_linear")
    panels: list[tuple[str, NDArray[Any], dict[str, Any]]] = [
        (r"$\xi_0$", xi[0], {"cmap": "viridis", "vmin": 0.25, "vmax": 1}),
        *((rf"$\xi_{k}$", xi[k], small) for k in (1, 2, 3)),
        *((rf"$\xi_{k} - \bar\xi$", deviation[k - 1], signed) for k in (1, 2, 3)),
        ("light the TD model misses", missed, _from_zero("magma", missed)),
        ("depolarization index", get("depolarization_index"), _FRACTION),
        ("entropy", get("entropy"), _FRACTION),
        ("depolarization power (Lu-Chipman)", get("depolarization_power"), _FRACTION),
        ("retardance (Lu-Chipman) / degrees", get("retardance_deg"), {"cmap": "viridis", "vmin": 0, "vmax": 180}),
        ("DoLP, unpolarized light", dolp, _from_zero("viridis", dolp)),
        ("AoLP, unpolarized light / degrees", orientation("polarizance_orientation_deg"), _CYCLIC),
        ("$|D|$ of the dominant process", get("dominant_diattenuation_linear"), _FRACTION),
        (r"$\psi$ of the dominant process / degrees", orientation("dominant_diattenuation_orientation_deg"), _CYCLIC),
    ]
    for name in ("crossed_linear", "aligned_linear", "crossed_circular"):
        if name in product.names:
            values = get(name)
            panels.append((name.replace("_", " ") + " over $m_{00}$", values, _from_zero("gray", values)))
    rows = -(-len(panels) // 4)
    aspect = product.shape[0] / max(product.shape[1], 1)
    figure = Figure(figsize=(17, 0.6 + rows * (0.5 + 3.6 * max(0.4, aspect))), layout="constrained")
    axes = figure.subplots(rows, 4)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, (label, values, keywords) in zip(axes.flat, panels, strict=False):
        cmap = colormaps[keywords["cmap"]].with_extremes(bad="0.7")
        shown = axis.imshow(values, interpolation="nearest", **(keywords | {"cmap": cmap}))
        axis.set_title(label, fontsize=10)
        figure.colorbar(shown, ax=axis, shrink=0.85)
    text = f"{SIMULATED}   {title}" if product.simulated else title
    figure.suptitle(text, color="darkred" if product.simulated else "black", fontsize=12)
    return figure


def _from_zero(cmap: str, values: NDArray[Any]) -> dict[str, Any]:
    return {"cmap": cmap, "vmin": 0, "vmax": _percentile(values, 99.5)}


def _percentile(values: NDArray[Any], percent: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percent)) if finite.size else 1.0
