"""Maps of the light that a sample sends back, where an instrument lights it in one polarized state.

Then no element of M is determined, but the Stokes vector sent back is. It is the first column of the matrix that would
make this light of unpolarized light: degrees and angle of polarization are those of that matrix's polarizance.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.maps.partial_quantities import determined_maps, partial_block, partial_facts
from processing.reduction.sent_light import sent_rows
from processing.reduction.systematic import Systematic
from processing.storage.images import SMALLEST, MuellerImage
from processing.storage.product import COMPANIONS, LIT_ERRORS, Plane, Product, ProductWriter

_BACK = "of the light that the sample sends back"
#: By the name that the same quantity of a matrix has: the name here, and what it is.
_NAMES = {
    "polarizance": ("dop", Plane((), "", f"degree of polarization {_BACK}")),
    "polarizance_linear": ("dolp", Plane((), "", f"degree of linear polarization {_BACK}")),
    "polarizance_circular": ("docp", Plane((), "", f"S3/S0 {_BACK}; positive: right circular")),
    "polarizance_orientation_deg": (
        "aolp_deg",
        Plane((), "degree", f"angle of linear polarization {_BACK}, 0 to 180, from +x of the analyzer frame"),
    ),
}
#: The name that the same quantity of a matrix has, by its name here.
OF_MATRICES = {own: name for name, (own, _) in _NAMES.items()}


def sent_back_planes(product: Product) -> dict[str, Plane]:
    """The maps, without their errors, of a product of `process reduce`; empty where elements are determined."""
    if "stokes" not in product.names:
        return {}
    names = determined_maps(_column(np.isfinite(product.get("stokes")).any(axis=(1, 2))), {})
    lit = Plane((), "", f"1 = S0 is above {LIT_ERRORS:g} of its standard errors", np.uint8)
    return {_NAMES[name][0]: _NAMES[name][1] for name in names if name in _NAMES} | {"lit": lit}


def sent_back_block(
    product: Product, rows: slice, planes: dict[str, Plane], systematic: Systematic | None = None
) -> dict[str, NDArray[Any]]:
    """These maps with their errors for some rows; noise taken off magnitudes, errors NaN where not determined."""
    image = MuellerImage.of(product, rows)
    stokes, errors = product.get("stokes", rows), product.get("stokes_errors", rows)
    seen = np.isfinite(stokes).any(axis=(1, 2))
    w = np.zeros_like(image.w)
    w[:, ::4] = image.w[:, ::4]
    values, value_errors = (np.full_like(image.values, np.nan) for _ in range(2))
    values[:, 0], value_errors[:, 0] = stokes, errors
    determined = ", ".join(f"m{k}0" for k in np.flatnonzero(seen))
    column = replace(
        image,
        values=values,
        errors=value_errors,
        w=w,
        sent=None,
        facts=image.facts | {"determined": determined},
        dark=np.linalg.pinv(w) @ (image.w @ image.dark),
    )
    wanted = [name for name, (own, _) in _NAMES.items() if own in planes]
    moves = None
    if systematic is not None:
        least = np.linalg.pinv(image.w, rcond=SMALLEST) @ image.fitted
        moves = np.zeros((len(systematic.directions), 16, *image.mask.shape))
        moved = np.stack(list(systematic.moves(least, sent_rows(image.w))))
        moves[:, ::4] = moved.reshape(len(moved), 4, *image.mask.shape)
    found = partial_block(column, wanted, {}, moves)
    out = {"lit": found["lit"]}
    for name in wanted:
        for suffix in ("", *COMPANIONS):
            if name + suffix in found:
                out[_NAMES[name][0] + suffix] = found[name + suffix]
    return out


def sent_back_facts(writer: ProductWriter, planes: dict[str, Plane]) -> dict[str, Any]:
    """As of a partial polarimeter, with what the maps are of."""
    facts = partial_facts(writer, [name for name in planes if name != "lit"])
    facts["warnings"] = [
        "the sample was lit in one polarized state: the maps are of the light that it sent back for it"
    ]
    return facts


def _column(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    out = np.zeros(16, dtype=bool)
    out[::4] = seen
    return out
