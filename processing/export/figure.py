"""Figures of products for a paper."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.errors import ProcessError
from processing.storage.products.product import Product, is_product
from processing.whole_file import whole_file

#: Resolution, for print.
FIGURE_DPI = 300
#: Planes that say where the others hold.
MASKS = ("valid", "lit")
#: Formats.
FIGURES = ("png", "pdf")


def write_figure(source: Path, path: Path, planes: Sequence[str]) -> None:
    """The figure of a product, or maps of some planes in the same colours, sharp enough to print.

    Elements of a Mueller matrix mean something over m00 alone: they are the product's own figure.
    """
    from processing.reports.colours import scale_of
    from processing.reports.figure_style import grid_figure
    from processing.reports.figures import product_figure

    if not is_product(source):
        raise ProcessError(f"{source} is no image; figures are made of products (`process reduce` makes one).")
    with Product(source) as product:
        if not planes or (list(planes) == ["mueller"] and product.kind == "mueller"):
            figure = product_figure(product)
        else:
            is_known = _valid_pixels(product)
            panels: list[tuple[str, NDArray[Any], dict[str, Any]]] = []
            for name in planes:
                values = product.get(name)
                unit = f" ({product.units(name)})" if product.units(name) else ""
                for index in np.ndindex(*values.shape[:-2]):
                    place = "".join(str(k) for k in index)
                    shown = values[index] if name in MASKS else np.where(is_known, values[index], np.nan)
                    scale = scale_of(name, product.units(name), shown)
                    limits = {"cmap": scale.colours, "vmin": scale.low, "vmax": scale.high}
                    panels.append((f"{name.replace('_', ' ')}{' ' + place if place else ''}{unit}", shown, limits))
            figure = grid_figure(panels, product.header.title, product.simulated)
    with whole_file(path) as new:
        # Without a date the same product gives the same bytes: `process export` then skips the file.
        figure.savefig(new, dpi=FIGURE_DPI, metadata={"CreationDate": None} if path.suffix == ".pdf" else None)


def _valid_pixels(product: Product) -> NDArray[np.bool_]:
    """Pixels whose values the product's own mask calls valid; all pixels without a mask."""
    mask = np.ones(product.shape, dtype=bool)
    for name in MASKS:
        if name in product.names:
            mask &= product.get(name) > 0
    return mask
