"""Maps that a report shows of a Mueller product: eigenvalues, xi0 with its error, DoLP and AoLP."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from processing.polarization import gradients
from processing.reports.figure_style import CYCLIC, PANEL_PIXELS, WORST_ORIENTATION_DEG, grid_figure
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Product, is_lit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def mueller_maps(product: Product, title: str) -> Figure | None:
    """xi0, its standard error, xi1 to xi3, the light that the TD model misses, DoLP and AoLP; every k-th pixel.

    Of a partial polarimeter what it determines of them; None if that is nothing.
    """
    height, width = product.shape
    step = max(1, -(-max(height, width) // PANEL_PIXELS))
    image = MuellerImage.of(product, slice(None, None, step))
    image = image.at(np.arange(image.mask.size).reshape(image.mask.shape)[:, ::step].reshape(-1))
    shape = (-(-height // step), -(-width // step))
    m = image.matrices.astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        derived = gradients.coherency(m) | gradients.polarizance(m)
    lit = is_lit(image.values[0, 0], image.errors[0, 0])

    def values(name: str) -> NDArray[Any]:
        value = derived[name].value
        return np.asarray(np.where(lit, value, np.nan).reshape(*value.shape[:-2], *shape))

    def errors(name: str) -> NDArray[Any]:
        gradient = derived[name].gradient
        gradient = gradient[0] if gradient.ndim == 4 else gradient
        return np.asarray(np.where(lit, np.sqrt(image.variance_of(gradient)), np.nan).reshape(shape))

    xi = values("coherency_eigenvalues")
    angle = values("polarizance_orientation_deg")
    angle = np.where(errors("polarizance_orientation_deg") > WORST_ORIENTATION_DEG, np.nan, angle)
    panels: list[tuple[str, NDArray[Any], dict[str, Any]]] = [
        (r"$\xi_0$", xi[0], {"vmin": 0.25}),
        (r"standard error of $\xi_0$", errors("coherency_eigenvalues"), {"cmap": "magma", "vmin": 0}),
        *((rf"$\xi_{k}$", xi[k], {"vmin": 0, "vmax": 1 / 3}) for k in (1, 2, 3)),
        ("light that the TD model misses", values("td_missed"), {"cmap": "magma", "vmin": 0}),
        ("DoLP under unpolarized light", values("polarizance_linear"), {"vmin": 0}),
        ("AoLP under unpolarized light, PSA frame / degrees", angle, CYCLIC),
    ]
    panels = [panel for panel in panels if np.isfinite(panel[1]).any()]
    return grid_figure(panels, title, product.simulated) if panels else None
