"""A full Mueller image from a linear Stokes capture: the TD model with the estimated xi0 and M00 (paper Sec. V-C)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.maps.xi0 import dominant_model, estimate_from_stokes
from processing.polarization import triply_degenerate
from processing.storage.images import StokesImage
from processing.storage.product import Plane, Product, ProductWriter, Step

PLANES = {
    "mueller": Plane((4, 4), "count", "Mueller matrix extrapolated by a TD model, row-major, not normalized"),
    "mueller_errors": Plane((4, 4), "count", "standard errors from the noise of xi0 and M00; not those of the model"),
    "valid": Plane((), "", "1 = xi0 is determined and physical", np.uint8),
}


def extrapolate_mueller(
    source: Path, geometry_file: Path, material_file: Path, out: Path, step: Step, overwrite: bool
) -> dict[str, Any]:
    """Write the extrapolated Mueller image of a Stokes product; returns its facts.

    Every element but 00 is alpha_0 m0: what the capture never saw (retardance, circular polarization) comes from
    the reflectance model alone.
    """
    with Product(source) as product:
        product.require("stokes")
        header, steps, shape = product.header, (*product.steps, step), product.shape
    m0 = dominant_model(header, geometry_file, material_file, shape)
    found = estimate_from_stokes(StokesImage.load(source), m0)
    with np.errstate(invalid="ignore"):
        values = triply_degenerate.mueller_matrix(m0, found.xi0, found.m00)
        weight = np.full(shape, np.nan) if found.alpha_0_stderr is None else found.alpha_0_stderr
        errors = np.abs(m0) * weight[..., None, None]
    errors[..., 0, 0] = found.m00_stderr
    valid = found.valid & ~found.unphysical
    facts: dict[str, Any] = {
        "method": "TD model, xi0 and M00 from the Stokes image, dominant process from the reflectance model",
        "valid_pixels": int(valid.sum()),
        "pixels": int(valid.size),
        "median_xi0": float(np.median(found.xi0[valid])) if valid.any() else None,
        "median_xi0_error": float(np.median(found.xi0_stderr[valid])) if valid.any() else None,
        "warnings": ["extrapolated: elements that the capture did not measure are the model's"],
    }
    with ProductWriter(out, "extrapolated", header, shape, PLANES, steps, overwrite) as writer:
        writer.write(
            slice(0, shape[0]), mueller=_planar(values), mueller_errors=_planar(errors), valid=valid.astype(np.uint8)
        )
        writer.seal(facts)
    return facts


def _planar(m: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.asarray(np.moveaxis(m, (-2, -1), (0, 1)), dtype=np.float32)
