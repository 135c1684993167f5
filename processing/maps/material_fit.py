"""Material constants from products of `process reduce`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from processing.doors import require_distinct
from processing.errors import ProcessError
from processing.geometry.frames import ScatteringGeometry
from processing.geometry.viewing import ViewingGeometry
from processing.reduction.sent_light import sent_rows
from processing.reflectance.material_fit import MaterialFit, fit_values
from processing.storage.products.images import SMALLEST, MuellerImage, StokesImage
from processing.storage.products.product import Product

#: Points, values (K, N), rows (K, 16) and covariance (N, K, K).
_Data = tuple[ScatteringGeometry, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
#: At most so many pixels of each image go into a fit.
PIXELS = 3000
#: Pixels nearer than this to the outline are left out: the default demosaicing reaches across it.
BORDER_PX = 4
#: Two coefficients of each pixel are fitted with the constants: as many elements leave nothing over.
LEAST_VALUES = 3
#: Difference of rows that is rounding of what the axes read.
ALIKE = 1e-4


def fit_products(
    sources: Sequence[Path], geometry_file: Path, *, correlation: bool = False
) -> tuple[MaterialFit, float, bool]:
    """Fit Mueller or Stokes products, see `fit_values`: fit, wavelength, simulated.

    Raises
    ------
    ProcessError : products of several kinds or wavelengths, simulated and measured mixed, no arm angle.
    """
    require_distinct(sources)
    kinds, simulated, wavelengths = set(), set(), set()
    for source in sources:
        with Product(source) as product:
            product.require("mueller", "stokes")
            kinds.add(product.kind)
            simulated.add(product.simulated)
            wavelengths.add(product.header.wavelength_nm)
            if product.header.omega_deg is None:
                raise ProcessError(f"{source}: the capture does not say its arm angle.")
    for what, values in (("kinds", kinds), ("wavelengths", wavelengths)):
        if len(values) > 1:
            raise ProcessError(f"one fit takes products of one of these {what} only: {sorted(map(str, values))}")
    if len(simulated) > 1:
        raise ProcessError("simulated and measured products were given together; fit them one by one.")
    view = ViewingGeometry.load(geometry_file)
    points, data, rows, covariance = (_of_mueller if kinds == {"mueller"} else _of_stokes)(sources, view)
    fit = fit_values(points, data, rows, covariance, max_pixels=len(covariance), correlation=correlation)
    return fit, float(wavelengths.pop()), simulated.pop()


def _of_mueller(sources: Sequence[Path], view: ViewingGeometry) -> _Data:
    parts, data, covariances = [], [], []
    rows: NDArray[np.float64] | None = None
    for source in sources:
        with Product(source) as product:
            points, index = _sample(view, product)
            image = MuellerImage.of(product).at(index)
        values, seen = determined_values(image)
        if rows is not None and (rows.shape != seen.shape or not np.allclose(rows, seen, atol=ALIKE)):
            raise ProcessError(f"{source} determines something else of M than the first product.")
        rows = seen
        parts.append(points)
        data.append(values)
        covariances.append(covariance_by_light(image, seen))
    if rows is None or len(rows) < LEAST_VALUES:
        raise ProcessError(f"a fit needs {LEAST_VALUES} elements of M or more; see what `process reduce` determined.")
    return _joined(parts), np.concatenate(data, axis=1), rows, np.concatenate(covariances)


def determined_values(image: MuellerImage) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What a product determines, (K, pixels), and the rows (K, 16) that lead to it from M.

    Elements of M, or the Stokes vector that is sent back where no element is determined alone.
    """
    if image.sent is None:
        return image.values.reshape(16, -1)[image.seen].astype(float), np.eye(16)[image.seen]
    seen = np.isfinite(image.sent).any(axis=(1, 2))
    return image.sent.reshape(4, -1)[seen].astype(float), sent_rows(image.w)[seen]


def covariance_by_light(image: MuellerImage, rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance (pixels, K, K) of rows (K, 16) . vec(M), as if the sample did not polarize.

    So that it follows no element's noise.
    """
    level = image.values[0, 0] if image.sent is None else image.sent[0]
    light = np.maximum(level.reshape(-1).astype(float), 0.0)
    if np.isnan(image.noise_slope).any():
        variance = np.ones((len(image.w), light.size))
    else:
        # A floor of nothing, in the dark, would be an infinite weight.
        floor = np.maximum(image.noise_floor, 1e-3 * image.noise_slope**2)
        variance = np.outer(image.noise_slope * image.w[:, 0], light) + floor[:, None]
    if image.facts["weighted"]:
        information = np.einsum("np,ni,nj->pij", 1 / variance, image.w, image.w, optimize=True)
        return np.asarray(rows @ np.linalg.pinv(information, rcond=SMALLEST**2, hermitian=True) @ rows.T)
    solve = rows @ np.linalg.pinv(image.w, rcond=SMALLEST)
    return np.asarray(np.einsum("np,in,jn->pij", variance, solve, solve, optimize=True))


def _of_stokes(sources: Sequence[Path], view: ViewingGeometry) -> _Data:
    parts, signals, covariances = [], [], []
    w = analyzers = None
    for source in sources:
        with Product(source) as product:
            points, index = _sample(view, product)
        image = StokesImage.load(source)
        if w is not None and not np.allclose(w, image.w):
            raise ProcessError(f"{source} was taken with another generator state than the first product.")
        w, analyzers = image.w, image.analyzers
        parts.append(points)
        signals.append(image.values.reshape(3, -1)[:, index].astype(float))
        covariances.append(image.covariance.reshape(-1, 3, 3)[index].astype(float))
    if w is None or analyzers is None:
        raise ProcessError("no product was given; there is nothing to fit.")
    rows = np.linalg.pinv(analyzers) @ w
    return _joined(parts), np.concatenate(signals, axis=1), rows, np.concatenate(covariances)


def _sample(view: ViewingGeometry, product: Product) -> tuple[ScatteringGeometry, np.ndarray]:
    # Lit and reduced pixels, evenly thinned: geometry and flat index.
    image = view.at(float(product.header.omega_deg or 0.0), *product.shape)
    # Pixels on the outline mix object and background, in a mosaic most of all.
    inner = binary_erosion(image.mask, iterations=BORDER_PX)
    good = np.flatnonzero(inner[image.mask] & (product.get("pixel_flags")[image.mask] == 0))
    if good.size == 0:
        raise ProcessError(f"{product.path}: no good pixel sees the object; check the geometry file.")
    chosen = good[np.linspace(0, good.size - 1, min(good.size, PIXELS)).astype(np.int64)]
    return image.points[chosen], np.flatnonzero(image.mask)[chosen]


def _joined(parts: Sequence[ScatteringGeometry]) -> ScatteringGeometry:
    vectors = (np.concatenate([getattr(p, name) for p in parts]) for name in ("normal", "to_source", "to_camera"))
    return ScatteringGeometry(*vectors)
