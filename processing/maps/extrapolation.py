"""A full Mueller image from a linear Stokes capture: the TD model with the estimated xi0 and M00.

Jarecki and Kupinski, Sec. V-C.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from processing.maps.xi0 import dominant_model, estimate_from_stokes, refit
from processing.polarization import triply_degenerate
from processing.reduction.systematic import INPUTS, Systematic
from processing.storage.products.images import StokesImage
from processing.storage.products.product import Plane, Product, Step
from processing.storage.products.product_writer import ProductWriter

#: Kind of the product.
EXTRAPOLATED = "extrapolated"

PLANES = {
    "mueller": Plane((4, 4), "count", "Mueller matrix extrapolated by a TD model, row-major, not normalized"),
    "mueller_errors": Plane((4, 4), "count", "standard errors from the noise of xi0 and M00; not those of the model"),
    "m00_correlation": Plane(
        (), "", "between the errors of m00 and of alpha_0, the common factor of all other elements"
    ),
    "valid": Plane((), "", "1 = xi0 is determined and physical", np.uint8),
}
#: Name of the plane that tells what is uncertain in the instrument.
DIRECTIONS = "alpha_0_directions"


def _systematic_planes(systematic: Systematic) -> dict[str, Plane]:
    text = "what one standard uncertainty of each uncertain input of the instrument does to alpha_0, in standard errors"
    return {
        "mueller_systematic": Plane((4, 4), "count", "standard uncertainty by the instrument's; it does not average"),
        DIRECTIONS: Plane((len(systematic.directions),), "", text),
    }


def extrapolate_mueller(
    source: Path, geometry_file: Path, material_file: Path, out: Path, *, step: Step, overwrite: bool
) -> dict[str, Any]:
    """Write the extrapolated Mueller image of a Stokes product; returns its facts.

    Every element but 00 is alpha_0 m0: what the capture never saw (retardance, circular polarization) comes from
    the reflectance model alone.
    """
    with Product(source) as product:
        product.require("stokes")
        header, steps, shape = product.header, (*product.steps, step), product.shape
        systematic = Systematic.of_product(product)
    m0 = dominant_model(header, geometry_file, material_file, shape)
    image = StokesImage.load(source)
    estimate = estimate_from_stokes(image, m0)
    with np.errstate(invalid="ignore"):
        values = triply_degenerate.mueller_matrix(m0, estimate.xi0, estimate.m00)
        errors = np.abs(m0) * estimate.alpha_0_stderr[..., None, None]
    errors[..., 0, 0] = estimate.m00_stderr
    valid = estimate.valid & ~estimate.unphysical
    facts: dict[str, Any] = {
        "method": "TD model, xi0 and M00 from the Stokes image, dominant process from the reflectance model",
        "valid_pixels": int(valid.sum()),
        "pixels": int(valid.size),
        "median_xi0": float(np.median(estimate.xi0[valid])) if valid.any() else None,
        "median_xi0_error": float(np.median(estimate.xi0_stderr[valid])) if valid.any() else None,
        "warnings": ["extrapolated: elements that the capture did not measure are the model's"],
    }
    planes: dict[str, NDArray[Any]] = {
        "mueller": _planar(values),
        "mueller_errors": _planar(errors),
        "m00_correlation": estimate.correlation * np.sign(4 * estimate.xi0 - 1),
        "valid": valid.astype(np.uint8),
    }
    every = PLANES
    if systematic is not None:
        fitted = np.tensordot(image.analyzers, image.values.astype(float), axes=1)
        # Of M/m00 alone: M = m00 e00 + alpha_0 (m0 - e00), and alpha_0/m00 = (4 xi0 - 1)/3.
        moved = 4 / 3 * estimate.m00 * refit(systematic, fitted, estimate.xi0, m0)
        of_alpha_0 = np.sqrt(np.square(moved).sum(axis=0))
        planes["mueller_systematic"] = _planar(np.abs(m0) * of_alpha_0[..., None, None])
        planes["mueller_systematic"][0, 0] = 0.0 * of_alpha_0
        with np.errstate(divide="ignore", invalid="ignore"):
            planes[DIRECTIONS] = moved / estimate.alpha_0_stderr
        every = PLANES | _systematic_planes(systematic)
        facts[INPUTS] = "; ".join(systematic.labels)
    with ProductWriter(out, EXTRAPOLATED, header, shape, planes=every, steps=steps, overwrite=overwrite) as writer:
        writer.write(slice(0, shape[0]), **planes)
        writer.seal(facts)
    return facts


@dataclass(frozen=True)
class ExtrapolatedImage:
    """An extrapolated Mueller image, or some rows of it, with what error propagation needs.

    M = m00 e00 + alpha_0 (m0 - e00), e00 being the element 00 alone: all noise is that of m00 and alpha_0.

    Attributes
    ----------
    values, errors : (4, 4, rows, columns), counts; NaN where the object is not.
    correlation : (rows, columns), of the errors of m00 and alpha_0, with the sign of alpha_0.
    directions : (D, rows, columns), what each uncertain input of the instrument does to alpha_0, in its standard error.
    """

    values: NDArray[np.float32]
    errors: NDArray[np.float32]
    correlation: NDArray[np.float32]
    directions: NDArray[np.float32] | None = None

    @classmethod
    def of(cls, product: Product, rows: slice = slice(None)) -> Self:
        """From an open product of `process extrapolate`."""
        names = ("mueller", "mueller_errors", "m00_correlation")
        directions = product.get(DIRECTIONS, rows) if DIRECTIONS in product.names else None
        values, errors, correlation = (product.get(name, rows) for name in names)
        return cls(values, errors, correlation, directions)

    def at(self, pixels: NDArray[np.int64]) -> Self:
        """The image of some pixels alone (n rows of one), given by their numbers in row-major order."""
        parts = (self.values, self.errors, self.correlation, self.directions)
        return type(self)(*(p if p is None else p.reshape(*p.shape[:-2], -1)[..., pixels, None] for p in parts))  # type: ignore[arg-type]

    @property
    def matrices(self) -> NDArray[np.float32]:
        """View (rows, columns, 4, 4)."""
        return np.moveaxis(self.values, (0, 1), (-2, -1))

    @property
    def moves(self) -> NDArray[np.float64] | None:
        """Change of M, with m00 fixed, by each uncertain input, (D, 16, rows, columns); None without."""
        if self.directions is None:
            return None
        moved = self.directions[:, None] * self._signed
        moved[:, 0] = 0.0
        return moved

    @property
    def _signed(self) -> NDArray[np.float64]:
        """(16, rows, columns): elements but 00 move by this times one common factor, up to the sign of alpha_0."""
        return np.asarray((np.sign(self.values) * self.errors).reshape(16, *self.correlation.shape), dtype=float)

    def covariance(self) -> NDArray[np.float64]:
        """Covariance (rows, columns, 16, 16) of the elements: they have two errors."""
        common = np.moveaxis(self._signed, 0, -1)
        common[..., 0] = 0.0
        result = common[..., :, None] * common[..., None, :]
        m00 = self.errors[0, 0].astype(float)
        result[..., 0, :] = result[..., :, 0] = (self.correlation * m00)[..., None] * common
        result[..., 0, 0] = m00**2
        return result

    def variance_of(self, gradient: NDArray[np.floating]) -> NDArray[np.float64]:
        """First-order variance (rows, columns) of a quantity with gradient (rows, columns, 16) by the elements."""
        of_m00 = gradient[..., 0] * self.errors[0, 0]
        common = np.einsum("ixy,xyi->xy", self._signed[1:], gradient[..., 1:])
        return np.asarray(of_m00**2 + common**2 + 2 * self.correlation * of_m00 * common)


def _planar(m: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.asarray(np.moveaxis(m, (-2, -1), (0, 1)), dtype=np.float32)
