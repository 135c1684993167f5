"""xi0 images: coherency eigenvalues of a Mueller image, or the two-coefficient estimate of a Stokes image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from processing.errors import ProcessError
from processing.geometry.viewing import ViewingGeometry
from processing.polarization.cloude import coherency_eigenvalues, xi0_and_dominant
from processing.polarization.xi0 import Xi0Estimate, estimate
from processing.reduction.mosaic.methods import REACH
from processing.reduction.mueller import Progress
from processing.reflectance.base import load_reflectance
from processing.storage.capture_schema import CaptureHeader
from processing.storage.images import MuellerImage, StokesImage, require_all_elements
from processing.storage.product import Plane, Product, ProductWriter, Step

#: The largest eigenvalue has a meaning of its own where it stands this many standard errors above the next.
DISTINCT = 3.0
#: A pixel holds light where m00 is this many standard errors.
LIT = 10.0
#: Limits of the validity mask of the two-coefficient estimate (docs/conventions.md, "xi0 without singularity").
MAX_CONDITION = 100.0
MAX_STDERR = 0.1

_XI0 = Plane((), "", "largest coherency eigenvalue over their sum; 1 = no depolarization, 1/4 = ideal depolarizer")
_XI0_ERRORS = Plane((), "", "standard errors of xi0, first order; noise of the intensities only")
_VALID = Plane((), "", "1 = xi0 is determined", np.uint8)
MUELLER_PLANES = {
    "xi0": _XI0,
    "xi0_errors": _XI0_ERRORS,
    "xi0_bias": Plane(
        (), "", "upward bias of xi0 by noise, second order, for noise alike in all elements; not subtracted"
    ),
    "eigenvalues": Plane((4,), "", "coherency eigenvalues over their sum, descending; negative ones are noise"),
    "eigenvalue_spread": Plane((), "", "largest deviation of xi1, xi2, xi3 from their mean: 0 if triply degenerate"),
    "valid": _VALID,
}
STOKES_PLANES = {
    "xi0": _XI0,
    "xi0_errors": _XI0_ERRORS,
    "m00": Plane((), "count", "throughput for unpolarized light"),
    "m00_errors": Plane((), "count", "standard errors of m00"),
    "condition": Plane((), "", "condition number of the two-coefficient fit"),
    "unphysical": Plane(
        (), "", "1 = outside [1/4, 1] by more than its standard error: speaks against the model", np.uint8
    ),
    "valid": _VALID,
}


def xi0_of_mueller(source: Path, out: Path, step: Step, overwrite: bool, progress: Progress | None) -> dict[str, Any]:
    """Write the eigenvalue image of a Mueller product; returns its facts.

    The standard error is first order: d xi0 = <dM, m0 - 4 xi0 e00> / (4 m00), m0 being the dominant process.
    """
    with Product(source) as product:
        require_all_elements(product)
        steps = (*product.steps, step)
        with ProductWriter(out, "xi0", product.header, product.shape, MUELLER_PLANES, steps, overwrite) as writer:
            for rows in product.row_blocks():
                if rows.stop > writer.rows_done:
                    writer.write(rows, **_eigenvalue_block(MuellerImage.of(product, rows)))
                if progress:
                    progress(rows.stop, product.shape[0])
            valid = writer.get("valid") > 0
            facts = _facts(writer.get("xi0"), writer.get("xi0_errors"), valid, "coherency eigenvalues")
            facts["median_xi0_bias"] = _median(writer.get("xi0_bias")[valid])
            facts["median_eigenvalue_spread"] = _median(writer.get("eigenvalue_spread")[valid])
            writer.seal(facts)
    return facts


def _eigenvalue_block(image: MuellerImage) -> dict[str, NDArray[Any]]:
    m = image.matrices
    eigenvalues = coherency_eigenvalues(m)
    xi0, m0 = xi0_and_dominant(m)
    gradient = np.asarray(m0, dtype=np.float32).reshape(*m0.shape[:2], 16).copy()
    gradient[..., 0] -= 4 * xi0
    with np.errstate(divide="ignore", invalid="ignore"):
        gradient /= 4 * image.values[0, 0][..., None]
        errors = np.sqrt(image.variance_of(gradient))
        distinct = eigenvalues[..., 0] - eigenvalues[..., 1] > DISTINCT * np.nan_to_num(errors)
        # A largest eigenvalue is pushed up by the noise that couples it to the others (second-order perturbation).
        bias = errors**2 * np.sum(1 / (eigenvalues[..., :1] - eigenvalues[..., 1:]), axis=-1)
    small = eigenvalues[..., 1:]
    spread = np.max(np.abs(small - small.mean(axis=-1, keepdims=True)), axis=-1)
    planes = {"xi0": xi0, "xi0_errors": errors, "xi0_bias": bias, "eigenvalues": np.moveaxis(eigenvalues, -1, 0)}
    lit = image.values[0, 0] > LIT * image.errors[0, 0]
    valid = np.isfinite(xi0) & distinct & lit & (errors <= MAX_STDERR)
    return planes | {"eigenvalue_spread": spread, "valid": valid.astype(np.uint8)}


def xi0_of_stokes(
    source: Path, geometry_file: Path, material_file: Path, out: Path, step: Step, overwrite: bool
) -> dict[str, Any]:
    """Write the xi0 image of a Stokes product, with a reflectance model as the dominant process; returns its facts.

    Raises
    ------
    ProcessError : the capture does not say its arm angle, or the object is not in the frame.
    """
    with Product(source) as product:
        product.require("stokes")
        header, steps = product.header, (*product.steps, step)
    image = StokesImage.load(source)
    m0 = dominant_model(header, geometry_file, material_file, image.mask.shape)
    # Next to the outline, demosaicing mixes object and background.
    reach = REACH[image.facts["method"]]
    inside = ndimage.minimum_filter(np.isfinite(m0[..., 0, 0]), size=2 * reach + 1)
    m0[~inside] = np.nan
    found = estimate_from_stokes(image, m0)
    planes: dict[str, NDArray[Any]] = {
        "xi0": found.xi0,
        "xi0_errors": found.xi0_stderr,
        "m00": found.m00,
        "m00_errors": found.m00_stderr,
        "condition": found.condition,
        "unphysical": found.unphysical.astype(np.uint8),
        "valid": found.valid.astype(np.uint8),
    }
    facts = _facts(found.xi0, found.xi0_stderr, found.valid, "two coefficients of the Stokes image")
    facts["unphysical_pixels"] = int(found.unphysical.sum())
    shape = image.mask.shape
    with ProductWriter(out, "xi0", header, (shape[0], shape[1]), STOKES_PLANES, steps, overwrite) as writer:
        writer.write(slice(0, shape[0]), **planes)
        writer.seal(facts)
    return facts


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
    valid = np.isfinite(plain.xi0) & (total > 0) & (plain.condition <= MAX_CONDITION) & (xi0_errors <= MAX_STDERR)
    unphysical = valid & ((plain.xi0 < 0.25 - xi0_errors) | (plain.xi0 > 1 + xi0_errors))
    weight = np.sqrt(spread[0, 0])
    return Xi0Estimate(
        plain.xi0, xi0_errors, total, m00_errors, plain.condition, valid, unphysical, plain.chi_square, weight
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
