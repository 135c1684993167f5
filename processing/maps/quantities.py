"""Every derived map of a Mueller image, with its standard error, as a product file."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from processing.arrays import RealArray
from processing.errors import ProcessError
from processing.maps.coherency_noise import coherency_noise
from processing.maps.dominant_intervals import set_dominant
from processing.maps.eigenvalue_intervals import set_eigenvalues, set_entropy, set_symmetric
from processing.maps.extrapolation import EXTRAPOLATED, ExtrapolatedImage
from processing.maps.intervals import (
    SEEN,
    has_own_95,
    moves_of,
    set_depolarization_power,
    set_differential,
    set_magnitudes,
    set_ratios,
    set_retardance,
    set_systematic,
)
from processing.maps.partial_quantities import Pairs, determined_maps, partial_block, partial_facts
from processing.maps.quantity_planes import NOISE, planes_of, with_errors
from processing.maps.stokes_vector import OF_MATRICES, is_stokes_vector, light_block, light_facts, light_planes
from processing.maps.xi0 import is_valid
from processing.polarization import gradients
from processing.polarization.decompositions.lu_chipman import lu_chipman
from processing.polarization.decompositions.symmetric import noise_of_core, symmetric
from processing.polarization.eigenvalue_noise import corrected
from processing.polarization.propagation import Derived
from processing.polarization.quantities import PAPER_PAIRS
from processing.polarization.scalar_files import scalar_quantities
from processing.polarization.sorted_eigenvalues import block_components
from processing.polarization.vector_noise import VectorNoise, of_slopes
from processing.reduction.mueller import Progress
from processing.reduction.systematic import INPUTS, Systematic
from processing.storage.products.images import MuellerImage, require_all_elements, seen_elements
from processing.storage.products.product import LIT_ERRORS, Plane, Product, ProductError, Step, is_lit
from processing.storage.products.product_writer import ProductWriter

#: Pixels that are read and written at a time.
BLOCK_PIXELS = 1 << 14
#: Pixels that go through all quantities at a time. Gradients take 128 bytes a pixel and quantity: those of more pixels
#: leave the cache, and the C library returns them to the system and fetches them anew.
CACHED_PIXELS = 1 << 12

#: Decompositions that are computed only where asked for, because they take seconds for a megapixel.
EXTRA = ("symmetric", "differential")

_GROUPS: tuple[Callable[[RealArray], dict[str, Derived]], ...] = (
    gradients.coherency,
    gradients.depolarization_index,
    gradients.diattenuation,
    gradients.polarizance,
    gradients.dominant,
    gradients.lu_chipman_quantities,
)


def quantities_of_mueller(
    source: Path,
    out: Path,
    step: Step,
    extra: Sequence[str] = (),
    *,
    pairs: Pairs = PAPER_PAIRS,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the derived maps of a Mueller product; returns the facts that the new product holds.

    Parameters
    ----------
    extra : any of `EXTRA`.
    pairs : generator and analyzer state by the name of the map.

    Raises
    ------
    ProductError : the source holds no whole Mueller matrices.
    ProcessError : an extra decomposition is unknown.
    """
    require_decompositions(extra)
    with Product(source) as product:
        maps = _maps(product, extra, pairs)
        steps = (*product.steps, step)
        with ProductWriter(
            out, "quantities", product.header, product.shape, planes=maps.planes, steps=steps, overwrite=overwrite
        ) as writer:
            for rows in product.row_blocks(BLOCK_PIXELS):
                if rows.stop > writer.rows_done:
                    writer.write(rows, **maps.block(rows))
                if progress:
                    progress(rows.stop, product.shape[0])
            facts = maps.facts(writer)
            writer.seal(facts)
    return facts


class _Maps(NamedTuple):
    """Maps that a product determines: planes of the new product, their values for some rows, and its facts."""

    planes: dict[str, Plane]
    block: Callable[[slice], dict[str, NDArray[Any]]]
    facts: Callable[[ProductWriter], dict[str, Any]]


def _maps(product: Product, extra: Sequence[str], pairs: Pairs) -> _Maps:
    """Maps of whole matrices, of the elements of a partial polarimeter, or of a Stokes vector.

    Raises ProductError: the product holds none of these, or decompositions were asked for that need whole matrices.
    """
    if product.kind == "stokes":
        raise ProductError(
            f"{product.path} is a linear Stokes image and holds what follows from it: dolp, aolp_deg and their errors. "
            "With a model of the surface, `process xi0` and `process extrapolate` take it."
        )
    product.require("mueller", EXTRAPOLATED)
    systematic = Systematic.of_product(product) if product.kind == "mueller" else None
    inputs = {INPUTS: product.facts[INPUTS]} if INPUTS in product.facts else {}
    if is_stokes_vector(product) and not extra:
        light = light_planes(product)
        own_95 = {name for name, of_matrices in OF_MATRICES.items() if has_own_95(of_matrices)}
        planes = with_errors(
            {name: plane for name, plane in light.items() if name != "stokes_covariance"},
            lambda name: name in own_95,
            systematic=bool(inputs),
        )
        return _Maps(
            planes | {"stokes_covariance": light["stokes_covariance"]},
            lambda rows: light_block(product, rows, systematic),
            lambda writer: light_facts(writer, product, light) | inputs,
        )
    maps = planes_of(extra, pairs)
    partial = _partial_maps(product, extra, pairs)

    def block(rows: slice) -> dict[str, NDArray[Any]]:
        image = image_of(product, rows)
        if isinstance(image, ExtrapolatedImage):
            return quantities_block(image, extra, pairs, image.moves)
        moves = None if systematic is None else moves_of(systematic, image)
        return partial_block(image, partial, pairs, moves) if partial else quantities_block(image, extra, pairs, moves)

    if partial:
        return _Maps(
            with_errors({name: maps[name] for name in [*partial, "lit"]}, systematic=bool(inputs)),
            block,
            lambda writer: partial_facts(writer, partial) | inputs,
        )
    return _Maps(
        with_errors(maps, systematic=bool(inputs)) | NOISE, block, lambda writer: _facts(writer, maps) | inputs
    )


def require_decompositions(extra: Sequence[str]) -> None:
    """Raise ProcessError for a name that is not in `EXTRA`."""
    unknown = sorted(set(extra) - set(EXTRA))
    if unknown:
        raise ProcessError(f"unknown decomposition {unknown[0]!r}; there are: {', '.join(EXTRA)}")


def _partial_maps(product: Product, extra: Sequence[str], pairs: Pairs) -> list[str]:
    """The maps that a partial polarimeter determines; empty for whole matrices.

    Raises ProductError: decompositions were asked for, which need whole matrices, or nothing is determined.
    """
    if product.kind == EXTRAPOLATED or int(product.facts.get("rank", 16)) == 16:
        return []
    names = [] if extra else determined_maps(seen_elements(product.facts), pairs)
    if not names:
        require_all_elements(product)
    return names


def image_of(product: Product, rows: slice) -> MuellerImage | ExtrapolatedImage:
    if product.kind == EXTRAPOLATED:
        return ExtrapolatedImage.of(product, rows)
    return MuellerImage.of(product, rows)


def quantities_block(
    image: MuellerImage | ExtrapolatedImage,
    extra: Sequence[str],
    pairs: Pairs,
    moves: NDArray[np.float64] | None = None,
    *,
    by_input: dict[str, NDArray[Any]] | None = None,
) -> dict[str, NDArray[Any]]:
    """Planes of the product for an image, or for some rows of it.

    Parameters
    ----------
    moves : (D, 16, rows, columns), what each uncertain input of the instrument does to M; see `moves_of`.
    by_input : of an image of at most `CACHED_PIXELS`: filled with what each does to the n numbers of each map,
        (n, pixels, D). The planes are then those of noise alone.
    """
    shape = image.values.shape[2:]
    size = shape[0] * shape[1]
    if size <= CACHED_PIXELS:
        return _cached_block(image, extra, pairs, moves=moves, by_input=by_input)
    each = None if moves is None else moves.reshape(*moves.shape[:2], size, 1)
    planes: dict[str, NDArray[Any]] = {}
    for start in range(0, size, CACHED_PIXELS):
        part = np.arange(start, min(start + CACHED_PIXELS, size))
        found = _cached_block(image.at(part), extra, pairs, moves=None if each is None else each[:, :, part])
        for name, plane in found.items():
            whole = planes.setdefault(name, np.empty((*plane.shape[:-2], size), plane.dtype))
            whole[..., part] = plane[..., 0]
    return {name: plane.reshape(*plane.shape[:-1], *shape) for name, plane in planes.items()}


def _cached_block(
    image: MuellerImage | ExtrapolatedImage,
    extra: Sequence[str],
    pairs: Pairs,
    *,
    moves: NDArray[np.float64] | None = None,
    by_input: dict[str, NDArray[Any]] | None = None,
) -> dict[str, NDArray[Any]]:
    """As `quantities_block`, of all pixels at once."""
    m = image.matrices.astype(float)
    # Where there is no light an eigenvalue solver only works on noise, slowly.
    lit = np.where(is_lit(image.values[0, 0], image.errors[0, 0])[..., None, None], m, np.nan)
    derived: dict[str, Derived] = {}
    with np.errstate(divide="ignore", invalid="ignore"):
        for group in _GROUPS:
            derived |= group(m)
        derived |= {name: scalar.derived(m) for name, scalar in scalar_quantities().items()}
        derived |= gradients.pairs(m, pairs)
        if "symmetric" in extra:
            factors = symmetric(lit)
            derived |= gradients.symmetric_quantities(lit, factors)
        if "differential" in extra:
            derived |= gradients.differential_quantities(lit)
        planes: dict[str, NDArray[Any]] = {}
        for name, quantity in derived.items():
            value, gradient = quantity.value, quantity.gradient
            planes[name] = value.astype(np.float32)
            each = gradient.reshape(-1, *m.shape[:2], 16)
            errors = [np.sqrt(image.variance_of(g)) for g in each]
            planes[f"{name}_errors"] = np.stack(errors).reshape(value.shape).astype(np.float32)
        vector = derived["retardance_vector_deg"]
        retardance = of_slopes(image.covariance(), vector.value, vector.gradient)
        planes["retardance_vector_covariance"] = retardance.packed[[0, 1, 2, 3, 5, 4]].astype(np.float32)
        polar = lu_chipman(m)
        of_core = noise_of_core(factors, image.covariance()) if "symmetric" in extra else None
        _set_intervals(planes, derived, m, image, depolarizer=polar.depolarizer, retardance=retardance, of_core=of_core)
        if moves is not None:
            moved = set_systematic(planes if by_input is None else dict(planes), derived, moves)
            if by_input is not None:
                by_input |= moved
    planes["lit"] = np.isfinite(lit[..., 0, 0]).astype(np.uint8)
    planes["lu_chipman_defined"] = polar.defined.astype(np.uint8)
    planes["negative_determinant"] = polar.negative_determinant.astype(np.uint8)
    if "symmetric" in extra:
        planes["symmetric_defined"] = factors.defined.astype(np.uint8)
    if "differential" in extra:
        planes["differential_defined"] = np.isfinite(derived["differential_depolarization_1"].value).astype(np.uint8)
    return planes


def _set_intervals(
    planes: dict[str, NDArray[Any]],
    derived: Mapping[str, Derived],
    m: NDArray[np.float64],
    image: MuellerImage | ExtrapolatedImage,
    *,
    depolarizer: NDArray[np.floating],
    retardance: VectorNoise,
    of_core: NDArray[np.float64] | None,
) -> None:
    """Intervals that first order does not give: see `processing.maps.intervals`."""
    error, linear_error = planes["retardance_deg_errors"], planes["retardance_linear_deg_errors"]
    diattenuation_error = planes["diattenuation_errors"]
    seen = np.full(m.shape[:2], np.inf)
    uneven, components = 1.0, 8.0
    planes["td_missed_noise"] = np.zeros_like(planes["td_missed"])
    planes["valid"] = np.isfinite(planes["td_missed"]).astype(np.uint8)
    if isinstance(image, MuellerImage):
        noise = coherency_noise(image)
        planes["valid"] &= is_valid(image, noise)
        xi = np.moveaxis(planes["coherency_eigenvalues"], 0, -1).astype(float)
        of_depolarizer = image.covariance_of_depolarizer()
        xi0 = corrected(xi, noise, of_depolarizer)
        components = block_components(of_depolarizer)
        uneven = np.sqrt(8 / components)
        shrunk = set_eigenvalues(planes, noise, xi0, components)
        # The gap without noise.
        first, second = planes["coherency_eigenvalues"][:2].astype(float)
        seen = (first - second) / (uneven * noise.coupling)
    of_process = {name for name in derived if name.startswith("dominant_")}
    others = {name: derived[name] for name in derived if name not in of_process}
    set_magnitudes(planes, others, m, image, noises={"retardance_deg": retardance})
    set_dominant(planes, derived, m, image.covariance(), seen=seen)
    # What is left of the light after the diattenuator carries the noise of all of it.
    passed = 1 - np.square(np.asarray(derived["diattenuation"].value) + diattenuation_error)
    least = SEEN * uneven * _relative_error(image)
    is_determined = (passed > 0) & _exceeds(depolarizer, least / passed)
    set_retardance(planes, derived, error, linear_error, is_determined=is_determined)
    set_depolarization_power(planes, _noise_of_depolarizer(image, derived), components, passed > least)
    if "differential_retardance_deg" in planes:
        set_differential(planes, is_determined & _is_principal(planes))
    if of_core is not None:
        set_symmetric(planes, of_core, components)
    set_ratios(planes, derived, image, m[..., 0, 0])
    if isinstance(image, MuellerImage):
        raw, slopes = derived["coherency_eigenvalues"][:2]
        set_entropy(planes, shrunk, slopes, derived["depolarization_index"].gradient, raw=raw, image=image)


def _is_principal(planes: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Whether the logarithm of M exists, and retardance is more than three errors from where it jumps."""
    retardance, error = (planes[f"differential_retardance_deg{end}"] for end in ("", "_errors"))
    return np.asarray(180 - retardance > SEEN * error)


def _exceeds(depolarizer: NDArray[np.floating], least: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether all three factors of Lu and Chipman's depolarizer are larger: without these the matrix stays definite."""
    sign = np.sign(depolarizer[..., 1, 1])
    x, y, z = (sign * depolarizer[..., k, k] - least for k in (1, 2, 3))
    a, b, c = (depolarizer[..., i, j] for i, j in ((1, 2), (2, 3), (1, 3)))
    minor = x * y - a**2
    return np.asarray((x > 0) & (minor > 0) & (z * minor + 2 * sign * a * b * c > x * b**2 + y * c**2))


def _relative_error(image: MuellerImage | ExtrapolatedImage) -> NDArray[np.float64]:
    """Root mean square error of the elements other than m00, over m00."""
    square = np.square(image.errors.astype(float))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.sqrt((square.sum(axis=(0, 1)) - square[0, 0]) / 15) / image.values[0, 0])


def _noise_of_depolarizer(
    image: MuellerImage | ExtrapolatedImage, derived: Mapping[str, Derived]
) -> NDArray[np.float64]:
    """Root mean square error of the nine elements of Lu and Chipman's depolarizer.

    The inverse of a diattenuator D multiplies noise along D by 1 / (1 - D^2), across by the root of that. It adds D
    times the noise of the polarizance.
    """
    square = np.square(image.errors.astype(float) / image.values[0, 0])
    part = np.square(np.asarray(derived["diattenuation"].value))
    block, column = square[1:, 1:].mean(axis=(0, 1)), square[1:, 0].mean(axis=0)
    noise = (block * (1 + 2 * (1 - part)) + column * part) / 3
    return np.asarray(np.sqrt(noise) / np.abs(1 - part))


def _facts(writer: ProductWriter, maps: Mapping[str, Plane]) -> dict[str, Any]:
    xi, xi_errors = writer.get("coherency_eigenvalues"), writer.get("coherency_eigenvalues_errors")
    lit = writer.get("lit") > 0
    facts: dict[str, Any] = {"pixels": int(lit.size), "pixels_with_light": int(lit.sum()), "warnings": []}
    if not lit.any():
        facts["warnings"].append(
            f"no pixel has m00 above {LIT_ERRORS:g} of its standard errors: there is nothing but noise"
        )
        return facts
    names = ("depolarization_index", "entropy", "td_missed", "diattenuation_linear", "polarizance_linear")
    # Of the same pixels as in `process xi0`; without standard errors all that have light.
    valid = writer.get("valid") > 0
    valid = valid if valid.any() else lit
    facts["median_xi0"], facts["median_xi0_error"] = _median(xi[0][valid]), _median(xi_errors[0][valid])
    for name in names:
        facts[f"median_{name}"] = _median(writer.get(name)[lit])
        facts[f"median_{name}_error"] = _median(writer.get(f"{name}_errors")[lit])
    if "entropy_systematic" in writer.planes:
        facts["median_xi0_systematic"] = _median(writer.get("coherency_eigenvalues_systematic")[0][valid])
        facts |= {f"median_{name}_systematic": _median(writer.get(f"{name}_systematic")[lit]) for name in names}
    for name in maps:
        if name.endswith("_defined") or name == "negative_determinant":
            facts[f"pixels_{name}"] = int(np.sum(writer.get(name)[lit]))
    if not np.isfinite(writer.get("polarizance_circular_errors")[lit]).any():
        facts["warnings"].append("the product holds no standard errors, so neither do the maps")
        return facts
    unphysical = (xi[3] < -3 * xi_errors[3]) & lit
    facts["pixels_unphysical_beyond_3_errors"] = int(unphysical.sum())
    if unphysical.sum() > 0.01 * lit.sum():
        facts["warnings"].append(
            f"{100 * unphysical.sum() / lit.sum():.1f} % of the lit pixels have a negative eigenvalue beyond three "
            "of its errors: noise does not make that, an instrument error does. Run `diagnose`."
        )
    return facts


def _median(values: NDArray[Any]) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None
