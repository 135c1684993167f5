"""Which derived maps the image of a partial polarimeter determines, and those maps.

Diattenuation needs the first row of M, polarizance the first column, light between two polarizers the elements that the
two polarizations meet. Eigenvalues and decompositions need all 16.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import BoolArray
from processing.maps.intervals import set_ellipticity, set_magnitudes, set_ratios, set_systematic
from processing.polarization import gradients
from processing.polarization.quantities import POLARIZATIONS, NamedStokes
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import is_lit
from processing.storage.products.product_writer import ProductWriter

Pairs = Mapping[str, tuple[NamedStokes, NamedStokes]]

_ROW, _COLUMN = (1, 2, 3), (4, 8, 12)
#: Elements, beside m00, that a map needs.
NEEDED = {
    "diattenuation": _ROW,
    "diattenuation_linear": _ROW[:2],
    "diattenuation_orientation_deg": _ROW[:2],
    "diattenuation_circular": _ROW[2:],
    "polarizance": _COLUMN,
    "polarizance_linear": _COLUMN[:2],
    "polarizance_orientation_deg": _COLUMN[:2],
    "polarizance_circular": _COLUMN[2:],
}


def determined_maps(is_determined: BoolArray, pairs: Pairs) -> list[str]:
    """Names of the maps that the determined elements (16,) allow."""
    needed = {name: list(elements) for name, elements in NEEDED.items()}
    for name, (generator, analyzer) in pairs.items():
        needed[name] = np.flatnonzero(np.outer(POLARIZATIONS[analyzer], POLARIZATIONS[generator])).tolist()
    return [name for name, elements in needed.items() if is_determined[0] and is_determined[elements].all()]


def partial_block(
    image: MuellerImage,
    names: list[str],
    pairs: Pairs,
    moves: NDArray[np.float64] | None = None,
    *,
    by_input: dict[str, NDArray[Any]] | None = None,
) -> dict[str, NDArray[Any]]:
    """The maps of these names with their errors, and `lit`, for an image or for some rows of it.

    `moves` and `by_input` are those of `processing.maps.quantities.quantities_block`.
    """
    # What was not determined is not in any of them.
    m = np.where(image.is_determined.reshape(4, 4), image.matrices.astype(float), 0.0)
    planes: dict[str, NDArray[Any]] = {}
    with np.errstate(divide="ignore", invalid="ignore"):
        derived = gradients.diattenuation(m) | gradients.polarizance(m) | gradients.pairs(m, pairs)
        derived |= gradients.ellipticity(m)
        for name in names:
            planes[name] = derived[name].value.astype(np.float32)
            planes[f"{name}_errors"] = np.sqrt(image.variance_of(derived[name].gradient)).astype(np.float32)
        set_magnitudes(planes, derived, m, image)
        set_ellipticity(planes)
        set_ratios(planes, derived, image, m[..., 0, 0])
        if moves is not None:
            into = planes if by_input is None else dict(planes)
            moved = set_systematic(into, {name: derived[name] for name in names}, moves)
            if by_input is not None:
                by_input |= moved
    planes["lit"] = is_lit(image.values[0, 0], image.errors[0, 0]).astype(np.uint8)
    return planes


def partial_facts(writer: ProductWriter, names: list[str]) -> dict[str, Any]:
    """Facts of the product: its maps, and their medians where there is light."""
    lit = writer.get("lit") > 0
    facts: dict[str, Any] = {
        "pixels": int(lit.size),
        "pixels_with_light": int(lit.sum()),
        "maps": ", ".join(names),
        "warnings": ["of a partial polarimeter: maps that need other elements of M are not there"],
    }
    for name in names:
        for part in (name, *(f"{name}_{end}" for end in ("errors", "systematic") if f"{name}_{end}" in writer.planes)):
            values = writer.get(part)[lit]
            values = values[np.isfinite(values)]
            facts[f"median_{part.replace('_errors', '_error')}"] = float(np.median(values)) if values.size else None
    return facts
