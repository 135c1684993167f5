"""Maps of a Stokes vector, of instruments that determine the returned light and no other element of M.

The sample is lit by unpolarized light, or in one polarized state, or is itself the source. The Stokes vector is the
first column of the matrix that makes this light of unpolarized light: its degrees of polarization, its angle and its
ellipticity are those of that matrix's polarizance.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import BoolArray
from processing.maps.intervals import moves_of
from processing.maps.partial_quantities import determined_maps, partial_block, partial_facts
from processing.reduction.sent_light import sent_parts, sent_rows
from processing.reduction.systematic import Systematic
from processing.storage.products.images import SMALLEST, MuellerImage, seen_elements
from processing.storage.products.product import COMPANIONS, LIT_ERRORS, Plane, Product
from processing.storage.products.product_writer import ProductWriter

_AXIS = "from +x of the analyzer frame"
#: By the name that the same quantity of a matrix has: the name here, and what it is.
NAMES = {
    "polarizance": ("dop", Plane((), "", "degree of polarization")),
    "polarizance_linear": ("dolp", Plane((), "", "degree of linear polarization")),
    "polarizance_circular": ("docp", Plane((), "", "S3/S0; positive: right circular")),
    "polarizance_orientation_deg": (
        "aolp_deg",
        Plane((), "degree", f"angle of linear polarization, 0 to 180, {_AXIS}"),
    ),
    "polarizance_ellipticity_deg": (
        "ellipticity_deg",
        Plane((), "degree", "ellipticity angle, -45 to 45; positive: right-handed"),
    ),
}
#: The name that the same quantity of a matrix has, by its name here.
OF_MATRICES = {of_light: name for name, (of_light, _) in NAMES.items()}
#: Elements of the packed covariance, by row and column.
_PACKED = tuple(zip(*[(k, k) for k in range(4)], *[(i, j) for i in range(4) for j in range(i + 1, 4)], strict=True))
_COVARIANCE = Plane((10,), "count2", "covariance of S: 00, 11, 22, 33, 01, 02, 03, 12, 13, 23; NaN: not determined")
_LIT = Plane((), "", f"1 = S0 is above {LIT_ERRORS:g} of its standard errors", np.uint8)


def is_stokes_vector(product: Product) -> bool:
    """Whether a product of `process reduce` determines a Stokes vector and no other element of M."""
    if product.kind != "mueller":
        return False
    return "stokes" in product.names or is_first_column(seen_elements(product.facts))


def is_first_column(is_determined: BoolArray) -> bool:
    """Whether the determined elements (16,) are in the first column of M and include more than m00."""
    return bool(is_determined[0] and is_determined[4:].any() and not is_determined.reshape(4, 4)[:, 1:].any())


def light_of(image: MuellerImage, stokes_errors: NDArray[np.float32] | None) -> MuellerImage:
    """The image as the first column of M; `stokes_errors` (4, rows, columns) where no element is determined alone."""
    if image.sent is None or stokes_errors is None:
        return image
    w = np.zeros_like(image.w)
    w[:, ::4] = image.w[:, ::4]
    values, errors = (np.full_like(image.values, np.nan) for _ in range(2))
    values[:, 0], errors[:, 0] = image.sent, stokes_errors
    determined = ", ".join(f"m{k}0" for k in np.flatnonzero(sent_parts(image.sent)))
    return replace(
        image,
        values=values,
        errors=errors,
        w=w,
        sent=None,
        facts=image.facts | {"determined": determined},
        dark=np.linalg.pinv(w) @ (image.w @ image.dark),
    )


def moves_of_light(systematic: Systematic, image: MuellerImage, *, is_held: bool = True) -> NDArray[np.float64]:
    """Change of the first column of M by each uncertain input of the instrument: (D, 16, rows, columns).

    `is_held` as in `Systematic.moves`.
    """
    if image.sent is None:
        return moves_of(systematic, image, is_held=is_held)
    least = np.linalg.pinv(image.w, rcond=SMALLEST) @ image.fitted
    moved = np.stack(list(systematic.moves(least, sent_rows(image.w), is_held=is_held)))
    moves = np.zeros((len(moved), 16, *image.mask.shape))
    moves[:, ::4] = moved.reshape(len(moved), 4, *image.mask.shape)
    return moves


def light_planes(product: Product) -> dict[str, Plane]:
    """The maps, without their errors, of a product for which `is_stokes_vector` holds."""
    is_determined = seen_elements(product.facts)
    if "stokes" in product.names:
        is_determined = np.zeros(16, dtype=bool)
        is_determined[::4] = sent_parts(product.get("stokes"))
    names = [NAMES[name] for name in light_quantities(is_determined)]
    stokes = Plane((4,), "count", f"Stokes vector, S1 {_AXIS}, S3 positive: right circular; NaN: not determined")
    return {"stokes": stokes, **dict(names), "stokes_covariance": _COVARIANCE, "lit": _LIT}


def light_quantities(is_determined: BoolArray) -> list[str]:
    """Names that the determined quantities of the light have as quantities of a matrix."""
    names = [name for name in determined_maps(is_determined, {}) if name in NAMES]
    return [*names, "polarizance_ellipticity_deg"] if "polarizance" in names else names


def light_block(product: Product, rows: slice, systematic: Systematic | None = None) -> dict[str, NDArray[Any]]:
    """The maps with their errors for some rows; noise taken off magnitudes, errors NaN where not determined."""
    matrices = MuellerImage.of(product, rows)
    image = light_of(matrices, product.get("stokes_errors", rows) if "stokes" in product.names else None)
    moves = None if systematic is None else moves_of_light(systematic, matrices)
    planes: dict[str, NDArray[Any]] = {"stokes": image.values[:, 0], "stokes_errors": image.errors[:, 0]}
    covariance = image.covariance()[..., ::4, ::4]
    is_determined = image.is_determined[::4]
    covariance = np.where(np.outer(is_determined, is_determined), covariance, np.nan)
    planes["stokes_covariance"] = np.moveaxis(covariance[..., _PACKED[0], _PACKED[1]], -1, 0).astype(np.float32)
    if moves is not None:
        planes["stokes_systematic"] = np.sqrt(np.square(moves[:, ::4]).sum(axis=0)).astype(np.float32)
    return planes | rename_planes(partial_block(image, light_quantities(image.is_determined), {}, moves))


def rename_planes(planes: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Planes of the polarizance under the names that they have here."""
    new_names = {name + suffix: NAMES[name][0] + suffix for name in NAMES for suffix in ("", *COMPANIONS)}
    return {new_names.get(name, name): plane for name, plane in planes.items()}


def light_facts(writer: ProductWriter, product: Product, planes: dict[str, Plane]) -> dict[str, Any]:
    """As of a partial polarimeter, with what the maps are of."""
    facts = partial_facts(writer, [name for name in planes if name in OF_MATRICES])
    facts["warnings"] = []
    if "stokes" in product.names:
        facts["warnings"] = [
            "the sample was lit in one polarized state: the maps are of the light that it sent back for it"
        ]
    return facts
