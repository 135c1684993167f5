"""xi0 images: coherency eigenvalues of a Mueller image, or the two-coefficient estimate of a Stokes image."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from processing.errors import ProcessError
from processing.geometry.viewing import ViewingGeometry
from processing.maps.coherency_noise import coherency_noise
from processing.maps.intervals import LEAST_M00, UNEVEN, moves_of, over_m00, widened
from processing.polarization.cloude import coherency_eigenvalues, xi0_and_dominant
from processing.polarization.eigenvalue_noise import EigenvalueNoise, corrected
from processing.polarization.xi0 import Xi0Estimate, estimate
from processing.reduction.mosaic.demosaic import method_of
from processing.reduction.mueller import Progress
from processing.reduction.sent_light import sent_parts
from processing.reduction.systematic import INPUTS, Systematic
from processing.reflectance.base import load_reflectance
from processing.storage.captures.schema import CaptureHeader
from processing.storage.products.images import MuellerImage, StokesImage, require_all_elements
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Plane, Product, Step
from processing.storage.products.product_writer import ProductWriter

#: Limits of the validity mask (docs/quantities.md, "xi0 and its interval"): on the noise, not on the outcome.
MAX_CONDITION = 100.0
MAX_STDERR = 0.1
#: Relative error of m00, by which all is divided: beyond, xi0 follows it more than the sample. As `lit` of quantities.
MAX_M00_ERROR = 0.1
#: Half the 95 % interval of a normal distribution, in standard deviations.
NORMAL_95 = 1.959964

_XI0 = Plane((), "", "largest coherency eigenvalue over their sum; 1 = no depolarization, 1/4 = ideal depolarizer")
_XI0_ERRORS = Plane((), "", "standard errors of xi0, both ends of its 68 and 95 % intervals within 1 and 1.96 of them")
_INTERVALS = {
    f"xi0_{level}": Plane((2,), "", f"lower and upper bound of the {level} % interval of xi0, not clipped at 1/4 or 1")
    for level in (68, 95)
}
VALID = Plane((), "", "1 = the noise is small enough for xi0 to say something; does not depend on xi0 itself", np.uint8)
MUELLER_PLANES = {
    "xi0": _XI0,
    "xi0_errors": _XI0_ERRORS,
    **_INTERVALS,
    "xi0_shift": Plane((), "", "what noise alone added to the largest eigenvalue; xi0 is without it"),
    "eigenvalues": Plane((4,), "", "coherency eigenvalues over their sum, descending, with their noise"),
    "eigenvalue_spread": Plane(
        (),
        "",
        "root of the sum of squares of xi1, xi2, xi3 minus their mean, the noise taken off; 0 if it explains all",
    ),
    "eigenvalue_spread_noise": Plane((), "", "the same of a triply degenerate matrix, by noise alone"),
    "valid": VALID,
}
STOKES_PLANES = {
    "xi0": _XI0,
    "xi0_errors": _XI0_ERRORS,
    **_INTERVALS,
    "m00": Plane((), "count", "throughput for unpolarized light"),
    "m00_errors": Plane((), "count", "standard errors of m00"),
    "condition": Plane((), "", "condition number of the two-coefficient fit"),
    "unphysical": Plane(
        (), "", "1 = outside [1/4, 1] by more than its standard error: speaks against the model", np.uint8
    ),
    "valid": VALID,
}


def xi0_of_mueller(
    source: Path, out: Path, step: Step, overwrite: bool, *, progress: Progress | None
) -> dict[str, Any]:
    """Write the eigenvalue image of a Mueller product; returns its facts.

    xi0 is the largest eigenvalue without what noise adds to it, see `processing.polarization.eigenvalue_noise`.
    """
    with Product(source) as product:
        require_all_elements(product)
        steps = (*product.steps, step)
        systematic = Systematic.of_product(product)
        planes = MUELLER_PLANES | systematic_planes(systematic)
        with ProductWriter(
            out, "xi0", product.header, product.shape, planes=planes, steps=steps, overwrite=overwrite
        ) as writer:
            for rows in product.row_blocks():
                if rows.stop > writer.rows_done:
                    image = MuellerImage.of(product, rows)
                    block = eigenvalue_block(image)
                    if systematic is not None:
                        set_xi0_systematic(block, moved_xi0(systematic, image))
                    writer.write(rows, **block)
                if progress:
                    progress(rows.stop, product.shape[0])
            valid = writer.get("valid") > 0
            facts = _facts(writer.get("xi0"), writer.get("xi0_errors"), valid, "coherency eigenvalues")
            if systematic is not None:
                facts |= _systematic_facts(systematic, writer.get("xi0_systematic")[valid])
            for name in ("xi0_shift", "eigenvalue_spread", "eigenvalue_spread_noise"):
                facts[f"median_{name}"] = _median(writer.get(name)[valid])
            writer.seal(facts)
    return facts


def eigenvalue_block(image: MuellerImage) -> dict[str, NDArray[Any]]:
    """Planes `MUELLER_PLANES` of an image, or of some rows of it."""
    eigenvalues = coherency_eigenvalues(image.matrices)
    noise = coherency_noise(image)
    result = corrected(eigenvalues.astype(float), noise, image.covariance_of_depolarizer())
    intervals = {}
    # What a noisy m00 does to the ratio beyond first order.
    shared = noise.with_m00 - (result.xi0 - 0.25) * noise.m00**2
    for name, ends, deviate in (("xi0_68", result.interval_68, 1.0), ("xi0_95", result.interval_95, NORMAL_95)):
        wide = result.xi0 + over_m00(ends - result.xi0, noise.m00, shared, deviate)
        wide = np.where(noise.m00 > UNEVEN, wide, ends)
        unknown = (noise.m00 > 1 / LEAST_M00) | (image.values[0, 0] <= 0)
        intervals[name] = np.where(unknown, np.array([0.25, 1.0])[:, None, None], wide)
    is_known = np.isfinite(result.xi0)
    # Without standard errors nothing can be taken off.
    xi0 = np.where(is_known, result.xi0, eigenvalues[..., 0])
    valid = is_known & is_valid(image, noise)
    return {
        "xi0": xi0,
        "xi0_errors": result.stderr,
        **intervals,
        "xi0_shift": result.shift,
        "eigenvalues": np.moveaxis(eigenvalues, -1, 0),
        "eigenvalue_spread": result.spread,
        "eigenvalue_spread_noise": np.sqrt(noise.others),
        "valid": valid.astype(np.uint8),
    }


def is_valid(image: MuellerImage, noise: EigenvalueNoise) -> NDArray[np.bool_]:
    """Whether the noise is small enough to determine xi0, (rows, columns); it does not depend on xi0 itself."""
    return np.asarray((image.values[0, 0] > 0) & (noise.overall <= MAX_STDERR) & (noise.m00 <= MAX_M00_ERROR))


def systematic_planes(systematic: Systematic | None) -> dict[str, Plane]:
    """Planes of what the instrument's uncertainty does to xi0; none where nothing is uncertain."""
    if systematic is None:
        return {}
    title = "what one standard uncertainty of each uncertain input of the instrument does to xi0"
    return {
        "xi0_systematic": Plane((), "", "standard uncertainty of xi0 by the instrument's; it does not average"),
        "xi0_directions": Plane((len(systematic.directions),), "", title),
    }


def set_xi0_systematic(planes: dict[str, NDArray[Any]], moved: NDArray[np.float64]) -> None:
    """Add `systematic_planes` from what each direction does to xi0, (D, rows, columns); widen both intervals by it."""
    systematic = np.sqrt(np.square(moved).sum(axis=0))
    planes |= {"xi0_systematic": systematic, "xi0_directions": moved}
    planes["xi0_95"] = widened(planes["xi0"], planes["xi0_95"], systematic)
    planes["xi0_68"] = widened(planes["xi0"], planes["xi0_68"], systematic / NORMAL_95)


def moved_xi0(systematic: Systematic, image: MuellerImage) -> NDArray[np.float64]:
    """Change of the largest eigenvalue by each direction, (D, rows, columns), to first order."""
    xi0, m0 = xi0_and_dominant(image.matrices)
    slope = m0.reshape(*m0.shape[:2], 16).astype(float)
    slope[..., 0] -= 4 * xi0
    with np.errstate(divide="ignore", invalid="ignore"):
        slope /= 4 * image.values[0, 0][..., None]
        return np.asarray(np.einsum("xyi,dixy->dxy", slope, moves_of(systematic, image)))


def _systematic_facts(systematic: Systematic, errors: NDArray[Any]) -> dict[str, Any]:
    return {INPUTS: "; ".join(systematic.labels), "median_xi0_systematic": _median(errors)}


def refit(
    systematic: Systematic, fitted: NDArray[np.floating], xi0: NDArray[np.float64], m0: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Change (D, ...) by each direction of xi0, the two-coefficient estimate of intensities (K, rows, columns)."""
    flat = fitted.reshape(len(fitted), -1)
    moved = []
    for direction in systematic.directions:
        signal = flat + systematic.bent(direction, flat) if direction.counts is not None else flat
        moved.append(estimate(signal.reshape(fitted.shape), None, direction.rows, m0).xi0 - xi0)
    return np.stack(moved)


def xi0_of_stokes(
    source: Path, geometry_file: Path, material_file: Path, out: Path, *, step: Step, overwrite: bool
) -> dict[str, Any]:
    """Write the xi0 image of a Stokes product, with a reflectance model as the dominant process; returns its facts.

    Raises ProcessError: the capture does not say its arm angle, or the object is not in the frame.
    """
    with Product(source) as product:
        product.require("stokes")
        header, steps = product.header, (*product.steps, step)
        systematic = Systematic.of_product(product)
    image = StokesImage.load(source)
    m0 = dominant_model(header, geometry_file, material_file, image.mask.shape)
    # Next to the outline, demosaicing mixes object and background.
    reach = method_of(image.facts["method"]).reach
    inside = ndimage.minimum_filter(np.isfinite(m0[..., 0, 0]), size=2 * reach + 1)
    m0[~inside] = np.nan
    result = estimate_from_stokes(image, m0)
    facts = _facts(result.xi0, result.xi0_stderr, result.valid, "two coefficients of the Stokes image")
    text = "of the noise of pixels by distance in rows and columns"
    fitted = np.tensordot(image.analyzers, image.values.astype(float), axes=1)
    with _two_coefficients(
        out, result, facts, header, steps=steps, overwrite=overwrite, systematic=systematic, fitted=fitted, m0=m0
    ) as writer:
        writer.array("neighbour_correlation", image.neighbour_correlation, "", text)
    return facts


def xi0_of_partial(
    source: Path, geometry_file: Path, material_file: Path, out: Path, *, step: Step, overwrite: bool
) -> dict[str, Any]:
    """Write the xi0 image of a partial polarimeter's product, with a reflectance model as the dominant process.

    The two coefficients need a measurement matrix of rank two only: whatever elements are determined, they are fitted.
    Of a weighted product the errors are those of equal weights, a little too large. Raises ProcessError: the product
    determines combinations of elements only; see also `dominant_model`.
    """
    with Product(source) as product:
        product.require("mueller")
        image, systematic = MuellerImage.of(product), Systematic.of_product(product)
    is_determined = image.is_determined if image.sent is None else sent_parts(image.sent)
    if is_determined.sum() < 2:
        raise ProcessError(f"{source} determines {image.facts['determined']}, and xi0 needs two numbers or more.")
    m0 = dominant_model(image.header, geometry_file, material_file, image.mask.shape)
    size = (-1, *image.mask.shape)
    fitted = np.where(image.mask.reshape(-1) & ~np.uint8(Mask.SATURATED), np.nan, image.fitted)
    fitted = fitted.reshape(size)
    variance = (image.intensity_variance * image.error_ratio).reshape(size)
    shared = image.w @ image.dark, np.sqrt(image.error_ratio).reshape(size[1:])
    result = estimate(fitted, variance, image.w, m0, shared=shared)
    facts = _facts(result.xi0, result.xi0_stderr, result.valid, f"two coefficients of {image.facts['determined']}")
    steps = (*image.steps, step)
    with _two_coefficients(
        out, result, facts, image.header, steps=steps, overwrite=overwrite, systematic=systematic, fitted=fitted, m0=m0
    ):
        pass
    return facts


@contextmanager
def _two_coefficients(
    out: Path,
    result: Xi0Estimate,
    facts: dict[str, Any],
    header: CaptureHeader,
    *,
    steps: tuple[Step, ...],
    overwrite: bool,
    systematic: Systematic | None,
    fitted: NDArray[np.floating],
    m0: NDArray[np.float64],
) -> Iterator[ProductWriter]:
    """Write an estimate of intensities `fitted` by m0; within the block arrays can be added. Completes the facts."""
    planes: dict[str, NDArray[Any]] = {
        "xi0": result.xi0,
        "xi0_errors": result.xi0_stderr,
        "xi0_68": result.xi0 + np.multiply.outer([-1.0, 1.0], result.xi0_stderr),
        "xi0_95": result.xi0 + np.multiply.outer([-NORMAL_95, NORMAL_95], result.xi0_stderr),
        "m00": result.m00,
        "m00_errors": result.m00_stderr,
        "condition": result.condition,
        "unphysical": result.unphysical.astype(np.uint8),
        "valid": result.valid.astype(np.uint8),
    }
    facts["unphysical_pixels"] = int(result.unphysical.sum())
    if systematic is not None:
        set_xi0_systematic(planes, refit(systematic, fitted, result.xi0, m0))
        facts |= _systematic_facts(systematic, planes["xi0_systematic"][result.valid])
    rows, columns = result.xi0.shape
    every = STOKES_PLANES | systematic_planes(systematic)
    with ProductWriter(out, "xi0", header, (rows, columns), planes=every, steps=steps, overwrite=overwrite) as writer:
        yield writer
        writer.write(slice(0, rows), **planes)
        writer.seal(facts)


def dominant_model(
    header: CaptureHeader, geometry_file: Path, material_file: Path, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """m0 (rows, columns, 4, 4) of a material on the object of a geometry file; NaN off the object."""
    if header.omega_deg is None:
        raise ProcessError("the capture does not say its arm angle; import it with --omega-deg.")
    geometry = ViewingGeometry.load(geometry_file).at(header.omega_deg, shape[0], shape[1])
    if not geometry.mask.any():
        raise ProcessError(
            f"{geometry_file}: no pixel sees a lit point of the object at Omega {header.omega_deg:g} degrees."
        )
    material = load_reflectance(material_file)
    return np.asarray(geometry.fill(material.mueller_jones(geometry.points, header.wavelength_nm)), dtype=float)


def estimate_from_stokes(image: StokesImage, m0: NDArray[np.float64]) -> Xi0Estimate:
    """Unweighted estimate of xi0 and M00 from a Stokes image, with the image's own covariance propagated.

    It equals the estimate from the channels' intensities, because the fit only sees their part that a linear
    Stokes vector explains.

    Parameters
    ----------
    m0 : (rows, columns, 4, 4), dominant process with element 00 equal to 1; NaN off the object.
    """
    w, analyzers = image.w, image.analyzers
    fitted = np.tensordot(analyzers, image.values.astype(float), axes=1)
    plain = estimate(fitted, None, w, m0)
    total = plain.m00
    with np.errstate(divide="ignore", invalid="ignore"):
        modulated = np.tensordot(w, m0.reshape(*m0.shape[:2], 16), axes=(1, 2))
        phi = np.stack(np.broadcast_arrays(modulated, w[:, :1, None]), axis=1)
        gram = np.einsum("kixy,kjxy->ijxy", phi, phi)
        det = gram[0, 0] * gram[1, 1] - gram[0, 1] ** 2
        inverse = np.array([[gram[1, 1], -gram[0, 1]], [-gram[0, 1], gram[0, 0]]]) / det
        weights = np.einsum("ijxy,kjxy,ks->isxy", inverse, phi, analyzers, optimize=True)
        spread = np.einsum("isxy,xyst,jtxy->ijxy", weights, image.covariance.astype(float), weights, optimize=True)
        alpha_0 = (4 * plain.xi0 - 1) / 3 * total
        u, v = 0.75 * (total - alpha_0) / total**2, -0.75 * alpha_0 / total**2
        xi0_errors = np.sqrt(u * u * spread[0, 0] + 2 * u * v * spread[0, 1] + v * v * spread[1, 1])
        m00_errors = np.sqrt(spread[0, 0] + 2 * spread[0, 1] + spread[1, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        # The error that xi0 would have at 1/4: a limit on its own error would select by outcome.
        noise = 0.75 * np.sqrt(spread[0, 0]) / total
    valid = np.isfinite(plain.xi0) & (total > 0) & (plain.condition <= MAX_CONDITION) & (noise <= MAX_STDERR)
    unphysical = valid & ((plain.xi0 < 0.25 - xi0_errors) | (plain.xi0 > 1 + xi0_errors))
    weight = np.sqrt(spread[0, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = (spread[0, 0] + spread[0, 1]) / (weight * m00_errors)
    return Xi0Estimate(
        plain.xi0,
        xi0_errors,
        total,
        m00_errors,
        plain.condition,
        valid,
        unphysical,
        plain.chi_square,
        weight,
        correlation,
    )


def _facts(xi0: NDArray[Any], errors: NDArray[Any], valid: NDArray[np.bool_], method: str) -> dict[str, Any]:
    warnings = [] if valid.any() else ["no pixel gives a valid xi0; look at condition, standard error and mask"]
    return {
        "method": method,
        "valid_pixels": int(valid.sum()),
        "pixels": int(valid.size),
        "median_xi0": _median(xi0[valid]),
        "median_xi0_error": _median(errors[valid]),
        "warnings": warnings,
    }


def _median(values: NDArray[Any]) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None
